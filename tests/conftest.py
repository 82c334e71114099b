"""For all tests: properties are tried on the same examples in every run, however slow the machine is.

To hunt with others: ``pytest --hypothesis-profile=default``.
"""

from hypothesis import settings

settings.register_profile("seeded", derandomize=True, deadline=None)
settings.load_profile("seeded")
