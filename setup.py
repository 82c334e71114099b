"""Which folder is which package: the five parts install as packages of `dehyst`.

So no module of a user's own, as ``sim.py`` or ``service.py`` beside his program, can take the place of one.
"""

from setuptools import find_packages, setup

PARTS = ("adaptive", "baselines", "sim", "service", "lab")
FOUND = [name for name in find_packages() if name.split(".")[0] in PARTS]

setup(
    packages=["dehyst", *(f"dehyst.{name}" for name in FOUND)],
    package_dir={"dehyst": "dehyst"} | {f"dehyst.{part}": part for part in PARTS},
)
