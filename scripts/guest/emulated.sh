# A guest with emulated controllers: Debian's kernel in QEMU. Sourced by scripts/vcan-guest.

prepare_emulated() {
  install_packages qemu-system-x86:qemu-system-x86_64
  (
    # Two first starts at once take turns.
    flock 9
    image=$(apt-cache depends linux-image-amd64 2>/dev/null |
      awk '$1 == "Depends:" { print $2; exit }')
    fetch_kernel "${image:-linux-image-amd64}" emulated './boot/vmlinuz-*' \
      '*/drivers/virtio/*' '*/drivers/char/*' '*/drivers/net/can/*' '*/fs/9p/*' '*/fs/fscache/*' \
      '*/fs/netfs/*' '*/net/9p/*' '*/net/can/*' '*/net/sched/*'
    warm_up
  ) 9>"$cache/lock"
  accelerator=$(accelerator)
}

# What would take the guest minutes is done here: compiling (for a processor that both have), and
# listing the fonts. It leaves the record of the main job of tests/vcan, on the embedded bus; both
# exchanges between processes are compiled in short runs over a socket.
warm_up() {
  rm -rf "$cache/embedded"
  export NUMBA_CPU_NAME=generic MPLCONFIGDIR="$cache/matplotlib"
  PYTHONPATH="$root/tests" "$bin/python" "$root/tests/vcan/main_job.py" "$cache/embedded"
  run_over_socket native && run_over_socket python-can
}

# $1: `[bus] exchange`
run_over_socket() {
  eds=$(printf '%s' "$root/eds" | sed 's/[#&\]/\\&/g')
  sed "s#/tmp/canwall.sock#$work/can.sock#; s#\.\./eds#$eds#; s/^\[bus\]/&\nexchange = \"$1\"/" \
    "$root/config/unixcan.toml" >"$work/$1.toml"
  rm -f "$work/can.sock"
  "$bin/canwall" drive "$work/$1.toml" >/dev/null &
  drive=$!
  # The drive has to be first: who opens the socket passes the frames on, in Python.
  while ! [ -S "$work/can.sock" ] && kill -0 "$drive" 2>/dev/null; do
    sleep 0.1
  done
  status=0
  "$bin/canwall" run "$work/$1.toml" --duration 0.5 --output "$work/$1" >/dev/null || status=$?
  kill "$drive"
  wait "$drive" || true
  return "$status"
}

# What COMMAND has there: see warm_up; and the controllers, for tests that no real ones may be taken
# for.
with_controllers='
export NUMBA_CPU_NAME=generic MPLCONFIGDIR="$root/.cache/guest/matplotlib"
export CANWALL_EMBEDDED_RECORD="$root/.cache/guest/embedded" CANWALL_CONTROLLERS="can0 can1"
'

# KVM where it works: where /dev/kvm exists, it may have no processor for it, or hang.
accelerator() {
  accelerator=kvm
  mkdir "$work/proof"
  if [ -w /dev/kvm ] && grep -qw 'vmx\|svm' /proc/cpuinfo &&
    boot_emulated "$work/proof" "$proof" true >/dev/null 2>&1 &&
    [ "$(cat "$work/proof/status")" = 0 ]; then
    echo kvm
  else
    echo tcg
  fi
}

# $1: folder to make the initramfs in; the rest: COMMAND.
make_initramfs() {
  tree=$1/tree
  shift
  mkdir -p "$tree/bin" "$tree/modules" "$tree/proc" "$tree/dev" "$tree/host"
  cp "$(command -v busybox)" "$tree/bin/busybox"
  module_files emulated virtio_pci virtio_console 9pnet_virtio 9p vcan can_raw can_bcm can_gw \
    kvaser_pci sch_netem |
    while read -r file; do
      cp "$file" "$tree/modules/"
      echo "insmod /modules/$(basename "$file")"
    done >"$tree/modules/load"
  before=$with_controllers inside "$@" >"$tree/inside"
  {
    printf '#!/bin/busybox sh\n'
    echo "root=$(quoted "$root")"
    cat "$root/scripts/guest/emulated_init"
  } >"$tree/init"
  chmod +x "$tree/init"
  (cd "$tree" && find . | busybox cpio -o -H newc 2>/dev/null) >"$tree.cpio"
}

# $1: folder, in which the guest's exit code is in `status` after it; $2: seconds; the rest: COMMAND.
boot_emulated() {
  folder=$1
  seconds=$2
  shift 2
  make_initramfs "$folder" "$@"
  : >"$folder/status"
  checkout=$(printf '%s' "$root" | sed 's/,/,,/g') # as QEMU has a comma in an option
  # An end of the input would disconnect the guest's output as well.
  mkfifo "$folder/input"
  timeout --foreground "$seconds" qemu-system-x86_64 -machine q35 -accel "$accelerator" -cpu max \
    -smp 1 -m 2048 -nodefaults -display none -no-reboot \
    -kernel "$cache/emulated/boot/"vmlinuz-* -initrd "$folder/tree.cpio" \
    -append "console=ttyS0 quiet panic=-1 mitigations=off no5lvl" \
    -serial "file:$folder/console" \
    -device virtio-serial-pci \
    -chardev stdio,id=output -device virtserialport,chardev=output,name=output \
    -chardev "file,id=status,path=$folder/status" -device virtserialport,chardev=status,name=status \
    -virtfs local,path=/,mount_tag=host,security_model=none,readonly=on,multidevs=remap \
    -virtfs "local,path=$checkout,mount_tag=checkout,security_model=none,multidevs=remap" \
    -object can-bus,id=bus -device kvaser_pci,canbus=bus -device kvaser_pci,canbus=bus \
    <>"$folder/input" &
  until_it_ends
}
