#!/usr/bin/env bash
# Make .venv with the pinned dependencies and, where there is none, a Vulkan driver.
#
# Run it as often as you like: what is already installed is not changed. As root it installs missing
# system packages with apt; otherwise it prints the commands for an administrator and stops.
#
#   PYTHON=/path/to/python3.12   the interpreter to use instead of the one that is found
#   MIKASA_SKIP_SYSTEM=1         do not check drivers and system libraries
#   MIKASA_NO_UV=1               install packages with pip alone
set -euo pipefail
cd "$(dirname "${BASH_SOURCE[0]}")/.."
source scripts/system.sh
source scripts/python.sh

VENV=.venv
VENV_PYTHON=.venv/bin/python
LOG=.venv/setup.log
STAMP=.venv/setup.stamp
UV='uv>=0.9,<1' # of the machine, not of the environment: it is in no constraint
NEEDED_GB=10 # the environment has 7 GB; wheels are unpacked beside it while they are installed

say() { printf 'setup: %s\n' "$*"; }
die() {
  printf 'setup: %s\n' "$@" >&2
  exit 1
}

# Everything that decides what is in the environment, and its path, which console scripts contain.
fingerprint() {
  { cat pyproject.toml constraints.txt scripts/setup.sh scripts/empty_wheels.py
    grep -E '^(version|home)' "$VENV/pyvenv.cfg"
    pwd; } | sha256sum | cut -d ' ' -f 1
}

is_up_to_date() {
  [ -f "$STAMP" ] && [ -x "$VENV_PYTHON" ] && [ "$(cat "$STAMP")" = "$(fingerprint)" ]
}

# Rebuild an environment that was moved, or whose interpreter is missing or too old.
is_usable_venv() {
  [ -f "$VENV/pyvenv.cfg" ] && grep -qF "$PWD/$VENV" "$VENV/pyvenv.cfg" && is_right_python "$VENV_PYTHON"
}

make_venv() {
  local free_gb
  # `venv --clear` would empty the folder that the link points to, which another checkout may be using.
  if [ -L "$VENV" ]; then
    die "$VENV is a link to $(readlink -f "$VENV"), expected a folder of this checkout." \
      "Remove the link (rm $VENV), then run 'make setup' again."
  fi
  free_gb=$(df -Pk . | awk 'NR == 2 { print int($4 / 1048576) }')
  if [ "$free_gb" -lt "$NEEDED_GB" ]; then
    die "$free_gb GB are free on this disk, $NEEDED_GB GB are needed." "Make room, then run 'make setup' again."
  fi
  say "making $VENV with $("$PYTHON" --version) ($PYTHON)"
  "$PYTHON" -m venv --clear "$VENV"
}

# Print large downloads and the installation, write the rest to the log. First pip's output, then uv's.
show_progress() {
  sed -u -nE \
    -e 's/^ *Downloading (.*\/)?([^-/]+-[^-]+)-.*\(([0-9.]+ GB|[0-9]{3,}\.[0-9] MB)\).*/setup:   downloading \2 (\3)/p' \
    -e 's/^Installing collected packages:(.*,){3}.*/setup:   installing/p' \
    -e 's/^ *Downloading ([^ ]+) \(([0-9.]+GiB|[0-9]{3,}\.[0-9]MiB)\).*/setup:   downloading \1 (\2)/p' \
    -e 's/^Prepared [0-9]{2,} packages.*/setup:   installing/p'
}

# uv unpacks a wheel once per machine and links it into each environment; pip unpacks 7 GB each time.
# It reads neither pip's files nor its variables, so the settings that it needs are passed on.
uv_install() {
  local index handed=("UV_HTTP_TIMEOUT=${UV_HTTP_TIMEOUT:-180}")
  if [ -n "${PIP_NO_INDEX:-}${MIKASA_NO_UV:-}" ]; then return 1; fi
  "$VENV_PYTHON" -m pip install --quiet --disable-pip-version-check "$UV" >>"$LOG" 2>&1 || return 1
  index=${PIP_INDEX_URL:-$("$VENV_PYTHON" -m pip config get global.index-url 2>/dev/null || true)}
  if [ -n "$index" ]; then handed+=("UV_DEFAULT_INDEX=$index"); fi
  if [ -n "${PIP_FIND_LINKS:-}" ]; then handed+=("UV_FIND_LINKS=${PIP_FIND_LINKS// /,}"); fi
  if [ -n "${PIP_CERT:-}" ]; then handed+=("SSL_CERT_FILE=$PIP_CERT"); fi
  env "${handed[@]}" "$VENV/bin/uv" pip install --python "$VENV_PYTHON" "$@" 2>&1 |
    tee -a "$LOG" | show_progress
}

# If uv fails, pip may succeed: it knows this machine's mirrors, wheel folders and certificates.
install_packages() {
  if uv_install "$@"; then return; fi
  say "  by pip"
  pip_install "$@"
}

pip_install() {
  if ! "$VENV_PYTHON" -u -m pip install --prefer-binary --progress-bar off --disable-pip-version-check \
    --no-compile "$@" 2>&1 | tee -a "$LOG" | show_progress; then
    tail -n 15 "$LOG" >&2
    die "pip failed; the lines above are the end of $LOG." \
      "Run 'make setup' again: what was downloaded is kept. Behind a proxy or offline: docs/install.md."
  fi
}

# Empty placeholders for packages that would overwrite others, or do not exist for this Python.
install_empty_wheels() {
  local folder
  folder=$(mktemp -d)
  "$VENV_PYTHON" scripts/empty_wheels.py constraints.txt "$folder"
  pip_install --no-deps --no-index "$folder"/*.whl
  rm -rf "$folder"
}

is_cv2_headless() {
  "$VENV_PYTHON" -c 'import re, sys, cv2; sys.exit(not re.search(r"GUI:\s+NONE", cv2.getBuildInformation()))' \
    2>/dev/null
}

repair_cv2() {
  if ! is_cv2_headless; then
    say "giving cv2 back to opencv-python-headless"
    pip_install --force-reinstall --no-deps -c constraints.txt opencv-python-headless
  fi
}

main() {
  [ "$(uname -sm)" = "Linux x86_64" ] || die "Linux on x86-64 is needed; this is $(uname -sm)."
  if [ -z "${MIKASA_SKIP_SYSTEM:-}" ]; then ensure_system; fi
  if is_up_to_date; then exit 0; fi
  if ! is_usable_venv; then
    ensure_python
    make_venv
  fi
  rm -f "$STAMP"
  : >"$LOG"
  say "installing the packages of constraints.txt (several GB the first time)"
  install_empty_wheels
  install_packages -c constraints.txt -e '.[dev]'
  repair_cv2
  fingerprint >"$STAMP"
  say "done. Next: make demo, or $VENV/bin/mikasa-vla doctor"
}

if [ "${BASH_SOURCE[0]}" = "$0" ]; then main "$@"; fi
