"""Roads: frozen descriptions that can be realised as a `Surface`."""
