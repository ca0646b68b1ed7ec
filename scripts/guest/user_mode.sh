# A guest that computes as fast as its host: user-mode Linux, a kernel that is a program. Sourced by
# scripts/vcan-guest.

#: Its memory [MiB].
memory=2048
#: Mappings that a process of the host may have; one of the guest has one for almost every page.
mappings=1048576

# Exits where user-mode Linux does not run, so call it in a subshell. Debian's is told how large
# registers are by xstate.c. The limit of mappings stays raised.
prepare_user_mode() {
  unavailable() {
    echo "canwall: no user-mode Linux, QEMU instead: $1" >&2
    exit 1
  }
  install_packages gcc:cc
  (
    flock 9
    fetch_kernel user-mode-linux user_mode ./usr/bin/linux.uml '*/drivers/net/can/*' '*/net/can/*' \
      '*/net/sched/*'
    cc -O2 -shared -fPIC -o "$cache/user_mode/xstate.so" "$root/scripts/guest/xstate.c" -ldl
  ) 9>"$cache/lock"
  limit=/proc/sys/vm/max_map_count
  [ "$(cat $limit)" -ge $mappings ] || as_root sh -c "echo $mappings >$limit" 2>/dev/null ||
    unavailable "as root: sysctl vm.max_map_count=$mappings"
  mkdir "$work/user_mode"
  boot_user_mode "$work/user_mode" "$proof" true >/dev/null 2>&1 || true
  [ "$(cat "$work/user_mode/status")" = 0 ] || unavailable "it does not start"
}

# $1: folder, in which the guest's exit code is in `status` after it; $2: seconds; the rest: COMMAND.
boot_user_mode() {
  folder=$1
  seconds=$2
  shift 2
  module_files user_mode vcan can_raw can_bcm can_gw sch_netem >"$folder/modules"
  before='' inside "$@" >"$folder/inside"
  {
    printf '#!/bin/sh\n'
    echo "root=$(quoted "$root") folder=$(quoted "$folder")"
    cat "$root/scripts/guest/user_mode_init"
  } >"$folder/init"
  chmod +x "$folder/init"
  : >"$folder/status"
  # The memory is a file, in /dev/shm if that has room for it.
  room=$(df --block-size=1M --output=avail /dev/shm 2>/dev/null | tail -n 1)
  [ "${room:-0}" -gt "$memory" ] && file_of_memory=/dev/shm || file_of_memory=$folder
  # What COMMAND says is on its second terminal, what the kernel says on its first.
  TMPDIR=$file_of_memory LD_PRELOAD=$cache/user_mode/xstate.so timeout --foreground "$seconds" \
    "$cache/user_mode/usr/bin/linux.uml" "mem=${memory}M" root=/dev/root rootfstype=hostfs \
    rootflags=/ ro quiet init="$folder/init" uml_dir="$folder" con=null con0=null,fd:1 con1=null,fd:3 \
    3>&1 >"$folder/console" 2>&1 </dev/null &
  until_it_ends
}
