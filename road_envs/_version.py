"""Version of the distribution `road-envs`."""

__version__ = "0.2.0"
