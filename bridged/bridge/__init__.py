"""One bridge: its life, and the parts that decide for it."""
