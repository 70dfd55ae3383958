"""What several test modules share: simulated devices and hosts, relays and bridges on them."""
