# Vulkan driver and system libraries. Sourced by setup.sh; knows nothing of pip.
#
# SAPIEN renders on a CPU with Mesa's lavapipe from 24.3 on; older ones fail with
# ErrorFeatureNotPresent. With an NVIDIA GPU, NVIDIA's own Vulkan driver is used and Mesa is not needed.
# shellcheck shell=bash

MINIMAL_MESA=24.3
APT_ETC=${APT_ETC:-/etc/apt}
OS_RELEASE=${OS_RELEASE:-/etc/os-release}
BACKPORTS_NAME=mikasa-vla-backports

os_field() { (. "$OS_RELEASE" && eval "echo \"\${$1:-}\""); }

# Reads to the end instead of `grep -q`: with pipefail, a writer that is cut off counts as a failure.
has_library() { PATH="$PATH:/sbin:/usr/sbin" ldconfig -p 2>/dev/null | grep -F "$1" >/dev/null; }

is_new_mesa() { [ -n "$1" ] && [ "$1" != "(none)" ] && dpkg --compare-versions "$1" ge "$MINIMAL_MESA"; }

installed_mesa() {
  dpkg-query -W -f '${db:Status-Status} ${Version}\n' mesa-vulkan-drivers 2>/dev/null |
    awk '$1 == "installed" { print $2; exit }'
}

candidate_mesa() { apt-cache policy mesa-vulkan-drivers 2>/dev/null | awk '/Candidate:/ { print $2 }'; }

# A container may have the GPU for computing but lack the graphics libraries of the driver.
has_nvidia_vulkan() {
  { [ -e /proc/driver/nvidia/version ] || [ -e /dev/nvidiactl ] || [ -e /dev/dxg ]; } &&
    has_library libGLX_nvidia.so.0
}

has_vulkan_driver() {
  # A user who names driver files has made a choice.
  if [ -n "${VK_DRIVER_FILES:-}${VK_ICD_FILENAMES:-}" ] || has_nvidia_vulkan; then return 0; fi
  if command -v dpkg-query >/dev/null; then
    is_new_mesa "$(installed_mesa)"
  else
    compgen -G '/usr/share/vulkan/icd.d/lvp_icd*.json' >/dev/null
  fi
}

needs_backports() { [ "$(os_field ID):$(os_field VERSION_ID)" = debian:12 ]; }

has_backports() {
  grep -qsE "^[^#]*$1-backports" "$APT_ETC/sources.list" "$APT_ETC"/sources.list.d/*.list \
    "$APT_ETC"/sources.list.d/*.sources
}

# Print the machine's own entry of the suite in $2, in file $1, with the backports suite in its place:
# the administrator's mirror and keyring are kept.
backports_from_deb822() {
  awk -v suite="$2" '
    BEGIN { RS = ""; FS = "\n" }
    {
      found = enabled = 0; text = ""
      for (i = 1; i <= NF; i++) {
        key = tolower($i); sub(/:.*/, "", key)
        if ($i ~ /^#/) continue
        if (key == "suites") {
          n = split($i, word, /[ \t]+/)
          for (j = 2; j <= n; j++) if (word[j] == suite || word[j] ~ /^(old)?stable$/) found = 1
          $i = "Suites: " suite "-backports"
        } else if (key == "enabled" && tolower($i) ~ /no *$/) enabled = -1
        else if (key == "types") { if ($i ~ /deb( |$)/) enabled += 1; $i = "Types: deb" }
        else if (key == "components") $i = "Components: main"
        text = text $i "\n"
      }
      if (found && enabled == 1) { printf "%s", text; exit }
    }' "$1"
}

backports_from_list() {
  awk -v suite="$2" '
    $1 == "deb" {
      options = ""; rest = $0; sub(/^deb[ \t]+/, "", rest)
      if (match(rest, /^\[[^]]*\][ \t]*/)) {
        options = substr(rest, 1, RLENGTH); sub(/[ \t]*$/, " ", options); rest = substr(rest, RLENGTH + 1)
      }
      split(rest, word, /[ \t]+/)
      if (word[2] == suite || word[2] ~ /^(old)?stable$/) {
        print "deb " options word[1] " " suite "-backports main"; exit
      }
    }' "$1"
}

# Print the kind of the file to write (`sources` or `list`), then its text.
backports_source() {
  local file text
  for file in "$APT_ETC"/sources.list.d/*.sources; do
    if [ -f "$file" ] && text=$(backports_from_deb822 "$file" "$1") && [ -n "$text" ]; then
      printf 'sources\n%s\n' "$text"
      return 0
    fi
  done
  for file in "$APT_ETC/sources.list" "$APT_ETC"/sources.list.d/*.list; do
    if [ -f "$file" ] && text=$(backports_from_list "$file" "$1") && [ -n "$text" ]; then
      printf 'list\n%s\n' "$text"
      return 0
    fi
  done
  return 1
}

# Fill COMMANDS with what an administrator has to type for the packages given.
plan_commands() {
  local sudo='' target=() codename source
  if [ "$(id -u)" != 0 ]; then sudo='sudo '; fi
  COMMANDS=()
  if [[ " $* " == *" mesa-vulkan-drivers "* ]] && needs_backports; then
    codename=$(os_field VERSION_CODENAME)
    target=(-t "$codename-backports")
    if ! has_backports "$codename"; then
      source=$(backports_source "$codename") ||
        die "no apt source of suite $codename was found to take the mirror from." \
          "Add the suite $codename-backports of your mirror to $APT_ETC/sources.list.d, then run 'make setup' again."
      COMMANDS+=("${sudo}tee $APT_ETC/sources.list.d/$BACKPORTS_NAME.${source%%$'\n'*} >/dev/null <<'EOF'
${source#*$'\n'}
EOF")
    fi
  fi
  COMMANDS+=("${sudo}apt-get update")
  COMMANDS+=("${sudo}apt-get install -y --no-install-recommends ${target[*]:+${target[*]} }$*")
}

# Print the apt packages that are missing, one a line.
missing_packages() {
  if ! has_vulkan_driver; then printf '%s\n' mesa-vulkan-drivers libvulkan1; fi
  if ! has_library libX11.so.6; then echo libx11-6; fi # SAPIEN links to it, screen or not
  if has_nvidia_vulkan && ! has_library libXext.so.6; then echo libxext6; fi
  # SAPIEN brings a Vulkan loader for those who cannot install one.
  if has_nvidia_vulkan && [ "$(id -u)" = 0 ] && ! has_library libvulkan.so.1; then echo libvulkan1; fi
  if ! is_usable_venv; then python_package; fi
}

run_commands() {
  local command log
  log=$(mktemp)
  export DEBIAN_FRONTEND=noninteractive
  for command in "${COMMANDS[@]}"; do
    if [[ "$command" == *' install '* && "$command" == *mesa-vulkan-drivers* && "$command" != *-backports* ]]; then
      is_new_mesa "$(candidate_mesa)" ||
        die "SAPIEN needs Mesa $MINIMAL_MESA or newer; apt offers $(candidate_mesa || true) here." \
          "Use Debian 12, Debian 13 or Ubuntu 24.04 with updates enabled, or an NVIDIA driver with Vulkan."
    fi
    say "  ${command%%$'\n'*}"
    if ! bash -c "$command" >"$log" 2>&1; then
      tail -n 15 "$log" >&2
      die "the command above failed. Run it by hand to see why, then run 'make setup' again."
    fi
  done
  rm -f "$log"
}

ensure_system() {
  local packages
  mapfile -t packages < <(missing_packages)
  if [ "${#packages[@]}" = 0 ]; then return; fi
  if ! command -v apt-get >/dev/null; then
    die "missing here: ${packages[*]} (Debian's names; Mesa $MINIMAL_MESA or newer)." \
      "Install them with this system's package manager, then: make setup MIKASA_SKIP_SYSTEM=1"
  fi
  plan_commands "${packages[@]}"
  if [ "$(id -u)" != 0 ]; then
    say "missing: ${packages[*]}. An administrator has to run:" >&2
    { echo; printf '%s\n' "${COMMANDS[@]}"; echo; } >&2
    die "then run 'make setup' again."
  fi
  say "installing ${packages[*]}"
  run_commands
  if [[ " ${packages[*]} " == *" mesa-vulkan-drivers "* ]] && ! has_vulkan_driver; then
    die "the installed Mesa is $(installed_mesa), $MINIMAL_MESA is needed." \
      "Run 'apt-cache policy mesa-vulkan-drivers' to see what apt prefers, and why."
  fi
}
