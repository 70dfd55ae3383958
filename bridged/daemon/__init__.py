"""The process around a bridge: configuration, systemd, status, signals."""
