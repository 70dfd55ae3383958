#!/bin/sh
# Boots the virtual machine, runs one command in it as root with the repository in /repo, and returns its exit status.
#
#   run.sh [-t SECONDS] [-k DIRECTORY] [-o OVERLAY] [-d DISK] COMMAND    COMMAND is a line for bash
#   run.sh [-o OVERLAY] [-d DISK] -i                                     a shell to look around in; Ctrl-D ends it
#
#   -t  give up after so long (1800)
#   -k  keep here what the command left in /ctl, with journal.txt and serial.log
#   -o  a directory laid over the guest's /
#   -d  a disk image, to read only, /dev/vdb in the guest
#
# The machine has two FTDI chips, FT245 to look at. The far end of ftdi0 (serial number RIG0001) is the socket ftdi0.sock in the
# host's side of /ctl, for a simulator there (hostside.py starts it when the guest asks); that of ftdi1 (RIG0002) is
# /dev/virtio-ports/ftdi1 in the guest. /dev/virtio-ports/qmp is QEMU's monitor: device_del and device_add are the hand at the plug.
#
# Each boot starts from the pristine image. Status 97: the guest died; 124: time is up; otherwise the command's own.
# Set CAN_BRIDGE_VM_ACCEL=kvm where KVM works: it is much faster, but /dev/kvm being there proves nothing.
# CAN_BRIDGE_VM_ACCEL=icount is a machine with one processor that takes exactly 1 ns for each instruction, and no
# time at all to wait: what is measured in it depends neither on this machine nor on what else runs here.
set -eu

here=$(cd "$(dirname "$0")" && pwd)
top=$(cd "$here/../../.." && pwd)
limit=1800 keep='' overlay='' disk='' interactive=''
while getopts t:k:o:d:i option; do
    case $option in
        t) limit=$OPTARG ;;
        k) keep=$OPTARG ;;
        o) overlay=$OPTARG ;;
        d) disk=$OPTARG ;;
        i) interactive=1 limit=0 ;;
        *) exit 2 ;;
    esac
done
shift $((OPTIND - 1))
[ -n "$interactive" ] || [ $# -gt 0 ] || { echo "usage: run.sh [-t SECONDS] [-k DIRECTORY] [-o OVERLAY] [-d DISK] -i | COMMAND" >&2; exit 2; }

image=$(sh "$here/build.sh" --where)
case $image in /*) ;; *) image=$PWD/$image ;; esac
[ -s "$image/root.ext4" ] || { echo "vm: no image yet: run build.sh first" >&2; exit 1; }

hostside=''
ctl=$(mktemp -d "${TMPDIR:-/tmp}/can-bridge-ctl.XXXXXX")
# shellcheck disable=SC2317  # the trap calls it
finish() {
    [ -z "$hostside" ] || { kill "$hostside" && wait "$hostside"; } 2>/dev/null || true
    rm -f "$ctl/repo.tar" "$ctl/overlay.tar" "$ctl"/*.sock
    if [ -n "$keep" ]; then
        mkdir -p "$keep"
        cp -r "$ctl/." "$keep/"
    fi
    rm -rf "$ctl"
}
trap finish EXIT
trap 'exit 130' INT TERM

# Compiled files of the host would confuse the guest's Python.
tar -cf "$ctl/repo.tar" -C "$top" --exclude-vcs --exclude=./.venv --exclude=./.cache --exclude=./build --exclude='./.*_cache' \
    --exclude=.hypothesis --exclude=__pycache__ --exclude='*.so' --exclude='*.egg-info' --exclude=./tests/native/build .
[ -z "$overlay" ] || tar -cf "$ctl/overlay.tar" -C "$overlay" .
: > "$ctl/serial.log"
if [ -n "$interactive" ]; then
    : > "$ctl/interactive"
    echo 'exec bash -i' > "$ctl/command"
    exec 3<&0
else
    printf '%s\n' "$*" > "$ctl/command"
    exec 3</dev/null
fi

mkdir "$ctl/host"
python=$top/.venv/bin/python
[ -x "$python" ] || python=python3
"$python" "$here/hostside.py" "$ctl/host" </dev/null >"$ctl/hostside.log" 2>&1 &
hostside=$!

case ${CAN_BRIDGE_VM_ACCEL:-tcg} in
    tcg) set -- -accel tcg,thread=multi,tb-size=512 -cpu max,la57=off -smp 2 ;;
    icount) set -- -accel tcg,thread=single,tb-size=512 -icount shift=0,sleep=off -cpu max,la57=off -smp 1 ;;
    *) set -- -accel "$CAN_BRIDGE_VM_ACCEL" -cpu host -smp 2 ;;
esac
status=0
# From within its directory: the path of a socket may have 107 characters only.
(cd "$ctl" && exec timeout --foreground "$limit" qemu-system-x86_64 "$@" -m 2048 \
    -nodefaults -no-user-config -display none -no-reboot \
    -machine q35,usb=off,vmport=off,smbus=off,sata=off,i8042=off,hpet=off,graphics=off \
    -kernel "$image/vmlinux" -initrd "$image/initrd.img" \
    -append "console=ttyS0 quiet loglevel=4 panic=-1 mitigations=off nokaslr audit=0 tsc=reliable no_timer_check systemd.show_status=0 random.trust_cpu=on" \
    -drive "file=$image/root.ext4,if=none,id=root,format=raw,snapshot=on,cache=unsafe" -device virtio-blk-pci,drive=root \
    ${disk:+-drive "file=$disk,if=none,id=disk,format=raw,readonly=on" -device virtio-blk-pci,drive=disk} \
    -chardev "file,id=serial,path=serial.log" -serial chardev:serial \
    -device virtio-serial-pci -chardev stdio,id=console,signal=off -device virtconsole,chardev=console \
    -fsdev local,id=ctl,path=.,security_model=none -device virtio-9p-pci,fsdev=ctl,mount_tag=ctl \
    -device qemu-xhci \
    -chardev socket,id=ftdi0,path=ftdi0.sock,server=on,wait=off \
    -device usb-serial,id=ftdi0,chardev=ftdi0,serial=RIG0001,always-plugged=on \
    -chardev socket,id=ftdi1,path=ftdi1.sock,server=on,wait=off \
    -device usb-serial,id=ftdi1,chardev=ftdi1,serial=RIG0002,always-plugged=on \
    -chardev socket,id=ftdi1far,path=ftdi1.sock -device virtserialport,chardev=ftdi1far,name=ftdi1 \
    -chardev socket,id=qmp,path=qmp.sock,server=on,wait=off -mon chardev=qmp,mode=control \
    -chardev socket,id=qmpfar,path=qmp.sock -device virtserialport,chardev=qmpfar,name=qmp \
    <&3) || status=$?

if [ -s "$ctl/status" ]; then
    status=$(cat "$ctl/status")
else
    [ "$status" = 124 ] || status=97
    echo "vm: the guest did not finish (status $status); the end of its serial console:" >&2
    tail -n 30 "$ctl/serial.log" | tr -d '\033' >&2
fi
exit "$status"
