#!/bin/sh
# Proves the README's two commands where nothing is: a bare Debian 12 in a directory, and a clone of HEAD in it.
#
#   sudo sh tests/system/fresh.sh [COMMAND…]     each COMMAND one line of shell; default: the README's two
#   KEEP_CACHE=1    use the virtual machine's image of this machine; otherwise that too is built from nothing
#
# Needs root, mmdebstrap, git, unshare, and 4 GB in TMPDIR. Takes 10 to 25 minutes; prints how long each command took.
set -eu
here=$(cd "$(dirname "$0")" && pwd)
top=$(cd "$here/../.." && pwd)
[ "$(id -u)" = 0 ] || { echo "fresh: needs root" >&2; exit 1; }
[ $# -gt 0 ] || set -- './dev demo --duration 5' './dev test'

work=$(mktemp -d "${TMPDIR:-/tmp}/can-bridge-fresh.XXXXXX")
root=$work/root
trap 'rm -rf --one-file-system "$work"' EXIT
trap 'exit 130' INT TERM
chmod 755 "$work"

echo "fresh: making a bare Debian 12 (1 minute)"
# shellcheck disable=SC2046  # one word per file
mmdebstrap --quiet --mode=root --variant=minbase --format=directory --aptopt='Acquire::Check-Valid-Until "false"' \
    bookworm "$root" $(sh "$here/vm/list-sources.sh" bookworm)
git clone -q "$top" "$root/root/can-bridge"

# How this machine reaches the network goes along: proxies, pip's settings, and its own certificate authorities if any.
set -- "$@" --
for name in $(env | sed -nE 's/^((PIP_[A-Z_]*|https?_proxy|no_proxy|HTTPS?_PROXY|NO_PROXY))=.*/\1/p'); do
    case $name in
        PIP_FIND_LINKS | PIP_CERT | PIP_CONFIG_FILE) ;; # paths of this machine
        *) set -- "$@" "$name=$(printenv "$name")" ;;
    esac
done
authorities=${PIP_CERT:-${SSL_CERT_FILE:-}}
if [ -n "$authorities" ]; then
    cp "$authorities" "$root/root/authorities.crt"
    set -- "$@" PIP_CERT=/root/authorities.crt SSL_CERT_FILE=/root/authorities.crt
fi

cache=''
if [ -n "${KEEP_CACHE:-}" ]; then
    cache=${XDG_CACHE_HOME:-$HOME/.cache}/can-bridge
    mkdir -p "$cache"
fi

# The mounts are in a name space of their own: they end with it, and rm cannot follow them.
cat > "$work/inside" <<'INSIDE'
#!/bin/sh
# $1 the root, $2 the cache or nothing, then the commands, then --, then the environment
set -eu
root=$1 cache=$2
shift 2
mount -t proc proc "$root/proc"
mount --rbind /sys "$root/sys"
mount --rbind /dev "$root/dev"
if [ -n "$cache" ]; then
    mkdir -p "$root/root/.cache/can-bridge"
    mount --bind "$cache" "$root/root/.cache/can-bridge"
fi
: > "$root/root/commands"
while [ "$1" != -- ]; do
    printf '%s\n' "$1" >> "$root/root/commands"
    shift
done
shift
worst=0
while read -r line <&3; do
    echo "fresh: $line"
    start=$(date +%s)
    status=0
    chroot "$root" env -i HOME=/root PATH=/usr/sbin:/usr/bin:/sbin:/bin TERM=dumb "$@" sh -c "cd /root/can-bridge && $line" </dev/null || status=$?
    echo "fresh: status $status after $(($(date +%s) - start)) s: $line"
    [ "$status" = 0 ] || worst=1
done 3< "$root/root/commands"
exit "$worst"
INSIDE
unshare --mount --propagation private sh "$work/inside" "$root" "$cache" "$@"
