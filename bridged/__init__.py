"""can-bridge: serial CAN adapters as Linux CAN interfaces."""
