# For the tools/with_* scripts: programs from Debian's or Ubuntu's packages, without root and without installing anything.
# shellcheck shell=bash
#
# The script that sources this has set -euo pipefail.

say() { printf '%s: %s\n' "${0##*/}" "$*" >&2; }
die() { say "$*"; exit 125; }

# cache_directory: where unpacked packages are kept, in $cache
cache_directory() {
  if [[ -n ${PUMPBENCH_CACHE:-} ]]; then cache=$PUMPBENCH_CACHE
  elif [[ -n ${XDG_CACHE_HOME:-} ]]; then cache=$XDG_CACHE_HOME/pumpbench
  elif [[ -n ${HOME:-} ]]; then cache=$HOME/.cache/pumpbench
  else die 'no HOME: set PUMPBENCH_CACHE to the directory to keep the tools in'; fi
  [[ $cache == /* ]] || cache=$PWD/$cache
}

# download LOG PACKAGES [OPTION...]: the packages and what they need that this machine has not; apt works that out
download() {
  local log=$1 packages=$2 apt needed
  shift 2
  # root's apt wants to give its rights away to a user who may not write here
  apt=(apt-get -q -o APT::Sandbox::User=root "$@")
  # shellcheck disable=SC2086 # a word for each package, here and below
  needed=$("${apt[@]}" --simulate --no-install-recommends install $packages 2>"$log" |
    awk '$1 == "Inst" && $3 !~ /^\[/ { print $2 }') || return 1 # a version in brackets: would be upgraded, is there
  # shellcheck disable=SC2086
  "${apt[@]}" download ${needed:-$packages} >"$log" 2>&1
}

# fetch_packages DIRECTORY SIZE PACKAGES USABLE FINISH: unpack the packages there, unless another one has meanwhile.
#   USABLE: a command that succeeds when what is wanted runs on this machine
#   FINISH: a command that completes what was unpacked into ./root, with DIRECTORY as its argument
fetch_packages() {
  local directory=$1 size=$2 packages=$3 usable=$4 finish=$5 parent=${1%/*} tool deb
  for tool in apt-get dpkg; do
    command -v "$tool" >/dev/null || die "no $tool to fetch $packages: install them, or what this system has for them"
  done
  mkdir -p -- "$parent" 2>/dev/null && { exec 9>"$parent/.lock"; } 2>/dev/null || die "cannot write to $parent"
  if command -v flock >/dev/null; then flock 9; fi # of two at once, the second finds the first one's
  if ! "$usable"; then
    say "fetching the Debian packages $packages into $directory (once, $size)"
    work=$(mktemp -d "$parent/.fetch.XXXXXX")
    trap 'rm -rf -- "$work"' EXIT
    cd "$work"
    mkdir -p lists/partial cache/archives/partial root/bin
    # the second try is with package lists of our own: there are none, or old ones, on this machine
    local own=(-o "Dir::State::Lists=$work/lists" -o "Dir::Cache=$work/cache")
    download log "$packages" || { apt-get -q -o APT::Sandbox::User=root "${own[@]}" update >log 2>&1 &&
      download log "$packages" "${own[@]}"; } ||
      die "cannot fetch $packages: $(grep -m 1 '^[EW]:' log || tail -n 1 log)"
    for deb in *.deb; do
      dpkg -x "$deb" root 2>log || die "cannot unpack $deb: $(tail -n 1 log)"
    done
    "$finish" "$directory"
    rm -rf -- "$directory"
    mv -T -- root "$directory" # at once: whoever looks sees all of it or nothing
    cd - >/dev/null
    rm -rf -- "$work"
    trap - EXIT
    hash -r
    "$usable" || die "what was fetched into $directory does not run: $("$usable" explain 2>&1 | tail -n 1)"
  fi
  exec 9>&-
}

# wrap NAME PROGRAM: root/bin/NAME runs PROGRAM of root/ with the libraries that came along, which are for it alone
wrap() {
  cat >"root/bin/$1" <<'SH'
#!/bin/sh
here=$(dirname "$(readlink -f "$0")")/..
for directory in "$here"/usr/lib/*-linux-gnu "$here"/lib/*-linux-gnu "$here"/usr/lib/*-linux-gnu/pulseaudio; do
  [ ! -d "$directory" ] || LD_LIBRARY_PATH=$directory${LD_LIBRARY_PATH:+:$LD_LIBRARY_PATH}
done
export LD_LIBRARY_PATH
[ ! -f "$here/fonts.conf" ] || export FONTCONFIG_FILE="$here/fonts.conf"
SH
  printf 'exec "$here/%s" "$@"\n' "$2" >>"root/bin/$1"
  chmod +x "root/bin/$1"
}
