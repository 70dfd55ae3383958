# The application of these examples: candump, cansend and the like. Yours takes its place.
#   docker build -t can-utils - < can-utils.Dockerfile
ARG BASE=debian:bookworm-slim
FROM ${BASE}
# hadolint ignore=DL3008
RUN apt-get update && apt-get install -y --no-install-recommends can-utils && rm -rf /var/lib/apt/lists/* /var/cache/apt/*
USER 65532:65532
CMD ["candump", "vcan0"]
