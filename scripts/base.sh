#!/usr/bin/env bash
# Install what the tasks of MIKASA-Base need: packages, and EGL, by which Memory Maze draws without a screen.
#
# As root it installs missing system packages with apt; otherwise it prints the commands for an administrator
# and succeeds, since all other tasks work without them.
#
#   MIKASA_SKIP_SYSTEM=1         do not check system libraries
set -euo pipefail
source "$(dirname "${BASH_SOURCE[0]}")/setup.sh" # goes to the root of the clone

say() { printf 'base: %s\n' "$*"; }

# labmaze has no wheel for Python 3.13: Memory Maze says so itself.
has_labmaze() { "$VENV_PYTHON" -c 'import labmaze' 2>/dev/null; }

has_software_gl() { compgen -G '/usr/lib/*/dri/swrast_dri.so' || compgen -G '/usr/lib/*/libgallium-*.so'; } >/dev/null

# Print the apt packages that are missing, one a line.
missing_gl_packages() {
  if ! has_library libEGL.so.1; then echo libegl1; fi
  if ! has_library libOpenGL.so.0 && ! has_library libGL.so.1; then echo libopengl0; fi # PyOpenGL loads one
  if ! has_library libEGL_nvidia.so.0 && ! has_software_gl; then echo libgl1-mesa-dri; fi
}

ensure_gl() {
  local packages
  mapfile -t packages < <(missing_gl_packages)
  if [ "${#packages[@]}" = 0 ]; then return; fi
  if ! command -v apt-get >/dev/null; then
    say "Memory Maze needs ${packages[*]} (Debian's names). Install them with this system's package manager." >&2
    return
  fi
  plan_commands "${packages[@]}"
  if [ "$(id -u)" != 0 ]; then
    say "Memory Maze needs ${packages[*]}. An administrator has to run:" >&2
    { echo; printf '%s\n' "${COMMANDS[@]}"; echo; } >&2
    return
  fi
  say "installing ${packages[*]}"
  run_commands
}

install_base() {
  "$VENV_PYTHON" -m pip install --quiet --disable-pip-version-check --no-deps --requirement scripts/base.txt
  if [ -z "${MIKASA_SKIP_SYSTEM:-}" ] && has_labmaze; then ensure_gl; fi
}

if [ "${BASH_SOURCE[0]}" = "$0" ]; then install_base; fi
