"""Which packages a command needs beyond those of the client, and the extra of the installation that brings them."""

from __future__ import annotations

from importlib.util import find_spec
from typing import Final

SERVE: Final = "serve"
VIEWER: Final = "viewer"
LAB: Final = "lab"
#: Import names of the packages that each extra of pyproject.toml brings. VIEWER and LAB bring those of SERVE too.
PACKAGES: Final[dict[str, tuple[str, ...]]] = {
    SERVE: ("numba", "scipy", "psutil", "threadpoolctl", "pyarrow", "shtab"),
    VIEWER: ("rerun",),
    LAB: ("matplotlib", "h5py", "nptdms", "openpyxl"),
    "torch": ("torch",),
    "peers": ("sklearn", "krls", "filterpy"),
}


def missing(extras: tuple[str, ...]) -> str:
    """The first package of ``extras`` that cannot be imported; "" where none is missing."""
    for extra in (SERVE, *extras) if extras else ():
        for package in PACKAGES[extra]:
            if not _is_there(package):
                return package
    return ""


def advice(package: str, extras: tuple[str, ...] = ()) -> str:
    """What to install for the import name ``package``; "" where no extra brings it.

    ``extras`` : those that the command needs, if it is known.
    """
    bring = extras or tuple(extra for extra, packages in PACKAGES.items() if package in packages)
    if not bring:
        return ""
    extra = f"[{','.join(bring)}]"
    return (
        f"needs the package {package}, which is not installed here: pip install 'dehyst{extra}' "
        f"(from a wheel: pip install 'dehyst-VERSION-py3-none-any.whl{extra}')"
    )


def _is_there(package: str) -> bool:
    try:
        return find_spec(package) is not None
    except ModuleNotFoundError:
        return False
