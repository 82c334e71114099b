"""Frozen configuration of a fleet."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

from adaptive.errors import InputError
from adaptive.online.config import LearnerConfig

#: What the windows of all axes are stepped by: compiled loops over the axes, or operations of torch.
Backend = Literal["auto", "compiled", "torch"]


@dataclass(frozen=True, slots=True)
class FleetConfig:
    """Frozen configuration of a fleet.

    learner : of every axis, see there.
    device : ``cpu``, or a device of torch. backend : ``compiled`` steps the windows by the single learner's own
    compiled code, on the processor; ``torch`` by operations of torch on any device, in the inverse form; ``auto`` takes
    the one that suits the device.
    threads : that share the axes of a step; the result does not depend on them.
    checks : most axes at a time whose model is under a control trial (`docs/learner.md`); others wait for their turn.
    """

    learner: LearnerConfig = field(default_factory=LearnerConfig)
    device: str = "cpu"
    backend: Backend = "auto"
    threads: int = 2
    checks: int = 16

    def __post_init__(self) -> None:
        if self.backend not in ("auto", "compiled", "torch"):
            raise InputError(f"backend: got {self.backend!r}, expected 'auto', 'compiled' or 'torch'")
        if self.backend == "compiled" and self.device != "cpu":
            raise InputError(f"backend: got 'compiled' with device {self.device!r}, expected 'torch' there")
        if not self.device:
            raise InputError("device: got nothing, expected 'cpu' or a device of torch, as 'cuda'")
        if not 1 <= self.threads <= 256:
            raise InputError(f"threads: got {self.threads}, expected 1 to 256")
        if self.checks < 1:
            raise InputError(f"checks: got {self.checks}, expected at least 1 axis")
        if self.in_torch and self.learner.solver.form != "inverse":
            raise InputError(
                f"learner.solver.form: got {self.learner.solver.form!r}, expected 'inverse', which backend 'torch' has"
            )

    @property
    def in_torch(self) -> bool:
        """Whether the windows are stepped by torch."""
        return self.backend == "torch" or (self.backend == "auto" and self.device != "cpu")
