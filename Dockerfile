# can-bridge in a container; how to run it: config/container/README.md.
#   docker build -t can-bridge .
# BASE is any Debian or Ubuntu with Python 3.11 or newer; amd64 and arm64 take the same steps.
ARG BASE=debian:bookworm-slim

# --- The package and what it needs, in an environment without pip -----------------------------------------------------
FROM ${BASE} AS build
# Where the network has a certificate authority of its own: its bundle, mounted into the build.
ARG PIP_CERT
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends \
        binutils ca-certificates gcc libc6-dev python3-dev python3-pip python3-venv
RUN python3 -m venv --without-pip /opt/can-bridge && rm /opt/can-bridge/bin/[Aa]ctivate*
WORKDIR /src

# What it needs has its own layer: it is not fetched again for each change of ours.
COPY pyproject.toml .
RUN python3 -c 'import tomllib; print(*tomllib.load(open("pyproject.toml", "rb"))["project"]["dependencies"], sep="\n")' \
        > requirements.txt \
    && pip --python /opt/can-bridge/bin/python install --no-cache-dir --no-compile -r requirements.txt \
    && find /opt/can-bridge \( -name '*.pyi' -o -name '*.pyx' -o -name '*.[ch]' \) -delete \
    && find /opt/can-bridge -name '*.so' -exec strip --strip-unneeded {} +

COPY README.md LICENSE ./
COPY bridged bridged
COPY config config
COPY systemd systemd
# Compiled here, since nobody can write a __pycache__ later; an unchecked file is good whatever the time of its source.
RUN pip --python /opt/can-bridge/bin/python install --no-cache-dir --no-compile --no-deps . \
    && rm /opt/can-bridge/lib/python3*/site-packages/can_bridge-*/direct_url.json \
    && /opt/can-bridge/bin/python -m compileall -q --invalidation-mode unchecked-hash /opt/can-bridge

# --- What runs --------------------------------------------------------------------------------------------------------
FROM ${BASE}
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends libusb-1.0-0 python3 \
    && rm -rf /usr/lib/python3*/test /usr/lib/python3*/pydoc_data \
        /var/lib/apt/lists/* /var/cache/apt/* /var/cache/debconf/*-old /var/lib/dpkg/*-old /var/log/apt /var/log/*.log \
    && echo 'can-bridge:x:65532:' >> /etc/group \
    && echo 'can-bridge:x:65532:65532::/nonexistent:/usr/sbin/nologin' >> /etc/passwd \
    && install -d -m 1777 /run/can-bridge /var/lib/can-bridge
COPY --from=build /opt/can-bridge /opt/can-bridge

ARG VERSION=0.1.0
LABEL org.opencontainers.image.title="can-bridge" \
    org.opencontainers.image.description="LAWICEL CAN232 and CANLAB USB2CAN adapters as Linux CAN interfaces" \
    org.opencontainers.image.version="${VERSION}" \
    org.opencontainers.image.licenses="MIT"

# The status socket, and what is known of the adapters' EEPROM: the two places that are written to, so that the root
# file system can be read-only. The bridge makes a directory of its own in each, whoever owns what is mounted there,
# and whatever user it runs as: /tmp's mode.
ENV PATH=/opt/can-bridge/bin:$PATH \
    PYTHONDONTWRITEBYTECODE=1 \
    XDG_RUNTIME_DIR=/run/can-bridge \
    XDG_STATE_HOME=/var/lib/can-bridge
VOLUME ["/run/can-bridge", "/var/lib/can-bridge"]
USER 65532:65532
# Started, not ready: an adapter that is not plugged in is no reason to hold back or to restart anything.
HEALTHCHECK --interval=5s --timeout=7s --start-period=10s CMD ["can-bridge", "status", "--check", "started"]
ENTRYPOINT ["can-bridge"]
CMD ["run", "/etc/can-bridge/can-bridge.yaml"]
