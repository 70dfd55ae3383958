"""can-bridge: serial CAN adapters as Linux CAN interfaces."""

VERSION = "0.1.0"
