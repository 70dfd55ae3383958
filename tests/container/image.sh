#!/bin/sh
# Builds the container images without a Docker engine: can-bridge by ./Dockerfile, and can-utils, the application of the examples.
#
#   image.sh            build them unless they are there; root's rights are asked for with sudo
#   image.sh --where    print the directory of what was built:
#                         store.ext4       both images in a store of podman's, for the virtual machine to mount
#                         sizes            in bytes, of the base and of can-bridge
#                         sbom.cdx.json    what is in can-bridge: Debian packages and Python distributions
#   image.sh --podman ARGUMENT…    podman of the store that the images were built in: localhost/can-bridge:TAG, TAG as --tag says
#   image.sh --tag
#
# Everything stays in the user's cache and is known by its recipe, so an image is built again when what goes into it has changed,
# and then the layers above the change only. The base is what Debian's own debian:bookworm-slim is, made by mmdebstrap, since no
# registry of images is reached from everywhere.
# Needs buildah, podman, crun, mmdebstrap, mke2fs; root, but no CAP_SYS_RESOURCE.
set -eu
export LC_ALL=C
PATH=$PATH:/usr/sbin:/sbin

here=$(cd "$(dirname "$0")" && pwd)
top=$(cd "$here/../.." && pwd)
cache=${CAN_BRIDGE_CACHE:-${XDG_CACHE_HOME:-$HOME/.cache}/can-bridge}
work=$cache/containers
suite=bookworm
base=docker.io/library/debian:$suite-slim
keep=6            # of what was built
store_max_mb=4000 # layers of earlier builds; then everything is built anew

# Of what is copied into the image, whatever git makes of it.
recipe() {
    cd "$top"
    find Dockerfile .dockerignore pyproject.toml README.md LICENSE bridged config systemd tests/container/image.sh tests/container/sbom.py \
        -type f ! -name '*.so' ! -name '*.pyc' ! -path 'config/container/*.yaml' ! -path 'config/container/*.md' \
        -exec sha256sum {} + | LC_ALL=C sort | sha256sum | cut -c1-12
}
key=$(recipe)
out=$cache/image-$key

die() {
    echo "image: $*" >&2
    exit 1
}

# crun refuses to start where cgroup v1 and v2 are mounted side by side, so it does not see the latter.
in_podman() {
    unshare -m sh -c 'mountpoint -q /sys/fs/cgroup/unified && umount /sys/fs/cgroup/unified; exec podman "$@"' podman \
        --root "$work/store" --runroot "$work/run" "$@"
}

in_buildah() {
    buildah --root "$work/store" --runroot "$work/run" bud -q --layers --pull-never --format docker --isolation chroot --network host \
        -v "$work/hand:/mnt:ro" --build-arg PIP_CERT=/mnt/ca.crt --build-arg "BASE=$base" "$@"
}

prepare() {
    mkdir -p "$work/hand"
    cp -L "${SSL_CERT_FILE:-/etc/ssl/certs/ca-certificates.crt}" "$work/hand/ca.crt"
    # Neither may raise limits without CAP_SYS_RESOURCE; the cgroups of a container in a container are nobody's.
    cat > "$work/containers.conf" <<'CONF'
[containers]
default_ulimits = ["nofile=1024:1024", "nproc=1024:1024"]
cgroups = "disabled"
CONF
}

# As Debian's: the essential packages and apt, without manuals and translations.
build_base() {
    cat > "$work/slim" <<'CONF'
path-exclude /usr/share/doc/*
path-include /usr/share/doc/*/copyright
path-exclude /usr/share/man/*
path-exclude /usr/share/info/*
path-exclude /usr/share/locale/*
CONF
    # shellcheck disable=SC2016,SC2046  # the hook's own $1; one word per file or option
    mmdebstrap --quiet --mode=root --variant=apt --format=tar \
        --aptopt='Acquire::Check-Valid-Until "false"' \
        $(sed 's/ /=/; s/^/--dpkgopt=/' "$work/slim") \
        --customize-hook="cp '$work/slim' \"\$1/etc/dpkg/dpkg.cfg.d/slim\"" \
        --customize-hook='cd "$1" && rm -rf var/lib/apt/lists/* var/cache/apt/* var/log/apt var/log/*.log' \
        "$suite" "$work/base.tar" $(sh "$here/../system/vm/list-sources.sh" "$suite")
    in_podman import -q "$work/base.tar" "$base"
    rm -f "$work/base.tar"
}

build() {
    if [ "$(du -sm "$work" 2>/dev/null | cut -f1)" -gt "$store_max_mb" ]; then in_podman rmi -a -f; fi
    in_podman image exists "$base" || build_base
    in_buildah -t "can-bridge:$key" -f "$top/Dockerfile" "$top"
    in_buildah -t "can-utils:$key" - < "$top/config/container/can-utils.Dockerfile"
    in_podman image inspect --format '{{.Size}}' "$base" "localhost/can-bridge:$key" > "$new/sizes"
    in_podman run -i --rm --no-healthcheck --network none --entrypoint python3 "localhost/can-bridge:$key" - < "$here/sbom.py" > "$new/sbom.cdx.json"

    # A store of its own on a file system of its own: nothing has to be unpacked in the virtual machine, which is slow.
    for name in can-bridge can-utils; do
        in_podman tag "localhost/$name:$key" "localhost/$name:latest"
        in_podman save -q "localhost/$name:latest" | podman --root "$new/store" --runroot "$new/run" --storage-driver overlay load -q
    done
    rm -rf "$new/run"
    umount "$new/store/overlay" 2>/dev/null || true
    mke2fs -q -t ext4 -O ^has_journal -m 0 -d "$new/store" "$new/store.ext4" "$(($(du -sm "$new/store" | cut -f1) * 5 / 4 + 40))M"
    rm -rf "$new/store"
}

# Rename, so that nobody ever sees half of it; who comes second throws his own away. Other clones of the repository have
# other images, and may be using them.
publish() {
    chmod 755 "$new"
    mv -T "$new" "$out" 2>/dev/null || [ -s "$out/store.ext4" ] || die "cannot write $out"
    # shellcheck disable=SC2012  # our own names, by age
    ls -dt "$cache"/image-* | tail -n +$((keep + 1)) | while read -r old; do
        rm -rf "$old"
        # Not removed: their layers are what the next build begins with.
        in_podman untag "localhost/can-bridge:${old##*-}" || true
        in_podman untag "localhost/can-utils:${old##*-}" || true
    done
}

case ${1:-} in
    --where) echo "$out"; exit 0 ;;
    --tag) echo "$key"; exit 0 ;;
esac

if [ "$(id -u)" != 0 ]; then
    command -v sudo >/dev/null || die "building images needs root: run as root once: sh tests/container/image.sh, with CAN_BRIDGE_CACHE=$cache"
    exec sudo env "CAN_BRIDGE_CACHE=$cache" sh "$here/image.sh" "$@"
fi
export CONTAINERS_CONF="$work/containers.conf"
if [ "${1:-}" = --podman ]; then
    shift
    in_podman "$@"
    exit
fi
[ $# = 0 ] || die "usage: image.sh [--where | --tag | --podman ARGUMENT…]"
if [ -s "$out/store.ext4" ] && in_podman image exists "localhost/can-bridge:$key"; then exit 0; fi

for tool in buildah podman crun mmdebstrap mke2fs unshare; do
    command -v "$tool" >/dev/null || die "the images cannot be built here: $tool is missing"
done
echo "image: building the container images (15 seconds to 2 minutes)"
prepare
new=$(mktemp -d "$cache/new.XXXXXX")
trap 'umount "$new/store/overlay" 2>/dev/null || true; rm -rf "$new"' EXIT
trap 'exit 130' INT TERM
build >"$work/log" 2>&1 || { tail -n 30 "$work/log" >&2; die "failed; the whole log: $work/log"; }
publish
