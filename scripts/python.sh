# Find a Python that the dependencies exist for. Sourced by setup.sh; knows nothing of Vulkan.
# shellcheck shell=bash

OS_RELEASE=${OS_RELEASE:-/etc/os-release}

# A pyenv shim may exist and fail, and a Python built without its libraries breaks pandas: run it.
try_python() {
  "$1" -c 'import sys
(3, 12) <= sys.version_info[:2] <= (3, 13) or sys.exit("it is Python %d.%d" % sys.version_info[:2])
import bz2, ctypes, lzma, sqlite3, ssl' 2>&1
}

is_right_python() { try_python "$1" >/dev/null; }

can_make_venv() { "$1" -c 'import ensurepip, venv' >/dev/null 2>&1; }

python_candidates() {
  local root version
  if [ -n "${PYTHON:-}" ]; then
    command -v "$PYTHON" || true
    return
  fi
  for version in 3.12 3.13; do
    command -v "python$version" || true
    for root in "${PYENV_ROOT:-$HOME/.pyenv}/versions/$version".* \
      "${UV_PYTHON_INSTALL_DIR:-$HOME/.local/share/uv/python}/cpython-$version".*; do
      if [ -x "$root/bin/python$version" ]; then echo "$root/bin/python$version"; fi
    done
  done
  command -v python3 || true
}

# Print the first Python that is right and passes the further test named by $1.
find_python() {
  local candidate
  while IFS= read -r candidate; do
    if is_right_python "$candidate" && "$1" "$candidate"; then
      echo "$candidate"
      return 0
    fi
  done < <(python_candidates)
  return 1
}

# Print the apt package with a Python for .venv, or nothing if none is needed.
python_package() {
  local bare
  if find_python can_make_venv >/dev/null; then return; fi
  if bare=$(find_python true); then
    "$bare" -c 'import sys; print("python%d.%d-venv" % sys.version_info[:2])'
    return
  fi
  case "$(. "$OS_RELEASE" && echo "${ID:-}:${VERSION_ID:-}")" in
    ubuntu:24.04 | ubuntu:24.10) echo python3.12-venv ;;
    debian:13 | ubuntu:25.04 | ubuntu:25.10) echo python3.13-venv ;;
    # Nothing suitable in the distribution: an older Python can still run uv, which downloads one.
    *) if ! { command -v python3 && can_make_venv python3; } >/dev/null; then echo python3-venv; fi ;;
  esac
}

# uv comes from the package index and installs a Python into the user's folder.
fetch_python() {
  say "no Python 3.12 or 3.13 on this machine: fetching one with uv"
  python3 -m venv --clear .venv-uv && .venv-uv/bin/python -m pip install --quiet uv &&
    .venv-uv/bin/uv python install 3.12
  local status=$?
  rm -rf .venv-uv
  return "$status"
}

# Set PYTHON, or stop.
ensure_python() {
  if [ -n "${PYTHON:-}" ] && ! is_right_python "$PYTHON"; then
    die "PYTHON=$PYTHON is not a complete Python 3.12 or 3.13: $(try_python "$PYTHON" | tail -n 1)" \
      "Unset it, or name another one."
  fi
  PYTHON=$(find_python can_make_venv) && return
  if fetch_python; then PYTHON=$(find_python can_make_venv) && return; fi
  die "Python 3.12 or 3.13 is needed and was not found; uv could not fetch one either." \
    "Install one (for example: pyenv install 3.12) and run 'make setup' again," \
    "or name it: make setup PYTHON=/path/to/python3.12"
}
