from hypothesis import Phase, settings

# The first example of a test may compile kernels; the same examples are tried on every machine.
settings.register_profile("steady", deadline=None, derandomize=True)
settings.register_profile(
    "faults", settings.get_profile("steady"), phases=[Phase.explicit, Phase.generate]
)
settings.load_profile("steady")
