#!/bin/sh
# Hook of mmdebstrap (build.sh): downloads the suite's stock kernel into $1. Only unpacked later, never installed.
set -eu
export APT_CONFIG="$MMDEBSTRAP_APT_CONFIG"
package=$(apt-cache depends linux-image-amd64 | sed -n 's/.*Depends: \(linux-image-[^ ]*\).*/\1/p' | head -n 1)
cd "$1"
apt-get download -qq "$package"
