"""Settings of all unit tests."""

from hypothesis import settings

settings.register_profile("can-bridge", deadline=None)  # a slow machine is no failure
settings.load_profile("can-bridge")
