from hypothesis import settings

# The first example of a test may compile kernels; the same examples are tried on every machine.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.load_profile("steady")
