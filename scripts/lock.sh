#!/usr/bin/env bash
# Rewrite constraints.txt from what is installed in .venv. Run it after changing a range in
# pyproject.toml and after the tests have passed with the new versions.
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."

# Left out: the project itself, what installs (pip, uv) and the empty opencv-python (scripts/empty_wheels.py).
# A local label such as +cpu names a build, not a version: any build may do.
{
  echo "# The versions this repository was tested with, with Python 3.12. Written by scripts/lock.sh."
  .venv/bin/python -m pip list --format=freeze --exclude-editable --exclude opencv-python --exclude mikasa-vla-eval \
    --exclude pip --exclude uv |
    sed -E 's/^([A-Za-z0-9._-]+==[^+]+)\+.*$/\1/' | grep -E '^[A-Za-z0-9._-]+==' | LC_ALL=C sort -f
} >constraints.txt.tmp
mv constraints.txt.tmp constraints.txt
echo "constraints.txt: $(grep -c == constraints.txt) versions"
