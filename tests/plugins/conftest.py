"""Property tests of the science are about truth, not about how fast the machine is."""

from hypothesis import settings

settings.register_profile("science", deadline=None)
settings.load_profile("science")
