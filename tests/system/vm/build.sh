#!/bin/sh
# Builds the virtual machine of the system tests: Debian 12 with its stock kernel, booted by run.sh.
#
#   build.sh            build it unless it is there; root's rights are asked for with sudo
#   build.sh --where    print the directory it lives in: vmlinux, initrd.img, root.ext4
#
# The image stays in the user's cache and is known by its recipe (the files of this directory), so a newer kernel in the
# archive does not outdate it and a machine without a network can go on using it.
# Needs mmdebstrap, apt-get, mke2fs, cpio, depmod, python3.
set -eu
export LC_ALL=C
PATH=$PATH:/usr/sbin:/sbin

here=$(cd "$(dirname "$0")" && pwd)
cache=${CAN_BRIDGE_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/can-bridge}
key=$(cat "$here/build.sh" "$here/fetch-kernel.sh" "$here"/guest/* | sha256sum | cut -c1-12)
image=$cache/vm-$key

suite=bookworm
# The guest has Debian's own versions of our dependencies, the oldest we support; msgspec it has not.
packages=systemd,systemd-sysv,udev,dbus,kmod,procps,iproute2,can-utils,busybox-static,strace
packages=$packages,python3,python3-can,python3-serial,python3-yaml,python3-usb,python3-systemd
packages=$packages,python3-pytest,python3-pytest-timeout
# For the container tests; the images come on a disk of their own (tests/container/image.sh).
packages=$packages,podman,crun,catatonit,uidmap

# What of the kernel's modules goes in: CAN, serial lines, USB, and what the virtual machine itself stands on.
module_trees="arch crypto lib net fs/ext4 fs/jbd2 fs/mbcache.ko fs/9p fs/fscache fs/netfs fs/autofs fs/configfs fs/fuse fs/overlayfs
    drivers/net/can drivers/tty drivers/usb drivers/virtio drivers/block drivers/char drivers/hid"

# Loaded by the initial RAM disk: what it takes to see the root file system and a console.
early_modules="virtio_pci virtio_blk virtio_console ext4"

# Services that only cost time at each start.
unwanted="getty.target getty@tty1.service serial-getty@ttyS0.service serial-getty@hvc0.service console-getty.service
    getty-static.service apt-daily.timer apt-daily-upgrade.timer fstrim.timer e2scrub_all.timer e2scrub_reap.service
    systemd-timesyncd.service systemd-networkd.service systemd-journal-flush.service systemd-update-utmp.service
    systemd-hwdb-update.service systemd-pcrphase.service systemd-random-seed.service systemd-user-sessions.service
    systemd-binfmt.service proc-sys-fs-binfmt_misc.automount ldconfig.service dev-hugepages.mount
    systemd-logind.service modprobe@dm_mod.service modprobe@drm.service modprobe@loop.service modprobe@configfs.service
    modprobe@efi_pstore.service modprobe@fuse.service"

die() {
    echo "vm: $*" >&2
    exit 1
}

# The root file system into $root, the kernel's package unpacked into $work/kernel.
build_root() {
    # shellcheck disable=SC2046  # one word per file
    mmdebstrap --quiet --mode=root --variant=minbase --format=directory --include="$packages" \
        --aptopt='Acquire::Check-Valid-Until "false"' \
        --dpkgopt='path-exclude=/usr/share/doc/*' --dpkgopt='path-exclude=/usr/share/man/*' \
        --dpkgopt='path-exclude=/usr/share/locale/*' \
        --customize-hook="sh '$here/fetch-kernel.sh' '$work'" \
        "$suite" "$root" $(sh "$here/list-sources.sh" "$suite")
    dpkg-deb -x "$work"/linux-image-*.deb "$work/kernel"
    release=$(basename "$work"/kernel/lib/modules/*)
}

# The kernel as an ELF file, which QEMU enters directly: neither a BIOS nor a decompressor has to be emulated.
extract_kernel() {
    python3 - "$work/kernel/boot/vmlinuz-$release" "$out/vmlinux" <<'PYTHON'
import lzma, sys
packed = open(sys.argv[1], "rb").read()
start = packed.index(b"\xfd7zXZ\x00")
open(sys.argv[2], "wb").write(lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(packed[start:]))
PYTHON
}

install_modules() {
    from=$work/kernel/lib/modules/$release
    to=$root/usr/lib/modules/$release
    mkdir -p "$to/kernel"
    cp "$from"/modules.builtin "$from"/modules.builtin.modinfo "$from"/modules.order "$to/"
    for tree in $module_trees; do
        [ -e "$from/kernel/$tree" ] || continue
        mkdir -p "$(dirname "$to/kernel/$tree")"
        cp -r "$from/kernel/$tree" "$to/kernel/$tree"
    done
    rm -rf "$to/kernel/arch/x86/kvm"
    depmod -b "$root" "$release"
}

configure_guest() {
    echo vm > "$root/etc/hostname"
    echo '127.0.0.1 localhost vm' > "$root/etc/hosts"
    : > "$root/etc/fstab"
    : > "$root/etc/machine-id"
    echo 'net.core.rmem_max = 50000000' > "$root/etc/sysctl.d/can.conf" # candump -r, or it loses frames
    mkdir -p "$root/repo" "$root/ctl"
    install -m 755 "$here/guest/command.sh" "$root/usr/local/sbin/vm-command"
    install -m 644 "$here/guest/command.service" "$root/etc/systemd/system/vm-command.service"
    chroot "$root" systemctl -q enable vm-command.service
    # shellcheck disable=SC2086  # one word per unit
    chroot "$root" systemctl -q mask $unwanted
    rm -rf "$root"/var/cache/apt/* "$root"/var/lib/apt/lists/* "$root"/var/log/*.log
}

# The initial RAM disk: busybox, a few modules, and the step into the real root.
build_initrd() {
    initrd=$work/initrd
    mkdir -p "$initrd/bin" "$initrd/dev" "$initrd/proc" "$initrd/root" "$initrd/modules"
    cp "$root/bin/busybox" "$initrd/bin/"
    {
        echo '#!/bin/busybox sh'
        echo '/bin/busybox mount -t devtmpfs dev /dev'
        for module in $early_modules; do
            modprobe -d "$root" -S "$release" --show-depends "$module"
        done | awk '$1 == "insmod" && !seen[$2]++ { print $2 }' | while read -r file; do
            cp "$file" "$initrd/modules/"
            echo "/bin/busybox insmod /modules/$(basename "$file")"
        done
        echo '/bin/busybox mount -t ext4 -o rw,noatime /dev/vda /root'
        echo '/bin/busybox mount --move /dev /root/dev'
        echo 'exec /bin/busybox switch_root /root /lib/systemd/systemd'
    } > "$initrd/init"
    chmod 755 "$initrd/init"
    (cd "$initrd" && find . | cpio -o -H newc --quiet) > "$out/initrd.img"
}

build_disk() {
    size_mb=$(($(du -sm "$root" | cut -f1) + 600))
    mke2fs -q -t ext4 -O ^has_journal -m 0 -L vm -d "$root" "$out/root.ext4" "${size_mb}M" >/dev/null
}

# Rename, so that nobody ever sees half an image; who comes second throws his own away.
publish() {
    chown -R "${SUDO_UID:-0}:${SUDO_GID:-0}" "$out"
    chmod 755 "$out"
    mv -T "$out" "$image" 2>/dev/null || [ -s "$image/root.ext4" ] || die "cannot write $image"
    for old in "$cache"/vm-*; do
        [ "$old" = "$image" ] || rm -rf "$old"
    done
}

case ${1:-} in
    --where) echo "$image"; exit 0 ;;
    '') ;;
    *) die "usage: build.sh [--where]" ;;
esac
[ -s "$image/root.ext4" ] && exit 0

for tool in mmdebstrap apt-get mke2fs cpio depmod python3; do
    command -v "$tool" >/dev/null || die "the image cannot be built here: $tool is missing"
done
[ "$(dpkg --print-architecture)" = amd64 ] || die "the image cannot be built here: the machine is not amd64"
mkdir -p "$cache"
if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null || die "building the image needs root: run as root once: sh tests/system/vm/build.sh, with CAN_BRIDGE_CACHE=$cache"
    exec sudo env "CAN_BRIDGE_CACHE=$cache" sh "$here/build.sh"
fi

echo "vm: building the virtual machine's image, once (1 to 3 minutes, 400 MB in the cache)"
work=$(mktemp -d "${TMPDIR:-/tmp}/can-bridge-vm.XXXXXX")
out=$(mktemp -d "$cache/new.XXXXXX")
trap 'rm -rf "$work" "$out"' EXIT
trap 'exit 130' INT TERM
chmod 755 "$work"
root=$work/root
build_root >"$work/log" 2>&1 || { tail -n 30 "$work/log" >&2; die "mmdebstrap failed"; }
extract_kernel
install_modules
configure_guest
build_initrd
build_disk
publish
