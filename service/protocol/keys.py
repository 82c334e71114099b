"""Key expressions of the wire: ``dehyst/v1/{stage}/{axis}/{what}``. The version chunk changes with the format."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from service.protocol.errors import FieldError

ROOT = "dehyst/v1"
#: One chunk of a key: lower case, digits, underscore and hyphen, beginning with a letter, at most 64 characters.
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,63}\Z")
#: The name of the model that is always the best of those that learn.
AUTO: Final = "auto"


def check_name(field: str, name: object) -> str:
    """``name`` if it can be one chunk of a key, else InputError naming ``field``."""
    if not isinstance(name, str) or not _NAME.match(name):
        raise FieldError(
            field,
            repr(name),
            "1 to 64 of a-z, 0-9, _ and -, beginning with a letter",
            "wild cards, slashes and capitals cannot be part of a name on the wire",
        )
    return name


@dataclass(frozen=True, slots=True)
class Keys:
    """The keys of one axis. Raises InputError where a name cannot be part of a key."""

    stage: str
    axis: str

    def __post_init__(self) -> None:
        check_name("stage", self.stage)
        check_name("axis", self.axis)

    @property
    def base(self) -> str:
        return f"{ROOT}/{self.stage}/{self.axis}"

    @property
    def sample(self) -> str:
        """Published by the stage: what it measured."""
        return f"{self.base}/sample"

    @property
    def command(self) -> str:
        """Published by the controller: voltages by sequence number, ahead of time."""
        return f"{self.base}/command"

    @property
    def reference(self) -> str:
        """Published by the controller: what was wanted, by sequence number; for diagnostics only."""
        return f"{self.base}/reference"

    @property
    def feedforward(self) -> str:
        """Query: a desired trajectory in, voltages out."""
        return f"{self.base}/feedforward"

    @property
    def model(self) -> str:
        """Query and publication: the learnt model itself."""
        return f"{self.base}/model"

    @property
    def champion(self) -> str:
        """Publication: the best of the models that learn, itself."""
        return f"{self.base}/champion"

    @property
    def status(self) -> str:
        """Query and publication, 1 Hz: JSON."""
        return f"{self.base}/status"

    @property
    def event(self) -> str:
        """Publication: JSON, one thing that happened."""
        return f"{self.base}/event"

    @property
    def diagnostics(self) -> str:
        """Publication, 20 Hz while somebody listens: JSON, what the learner sees."""
        return f"{self.base}/diagnostics"

    @property
    def operate(self) -> str:
        """Query: a verb of the operator, JSON in and out."""
        return f"{self.base}/operate"

    @property
    def state(self) -> str:
        """Query, of services only: a checkpoint of the serving instance as it is, for its standby."""
        return f"{self.base}/state"

    @property
    def claim_any(self) -> str:
        """Matches the claims of every instance that serves this axis or wants to."""
        return f"{self.base}/claim/*/*"

    def claim(self, epoch: int, instance: str) -> str:
        """Liveliness: ``instance`` serves since take-over number ``epoch``; the highest one counts."""
        return f"{self.base}/claim/{epoch}/{check_name('instance', instance)}"

    def standby(self, instance: str) -> str:
        """Liveliness, and publication 1 Hz: JSON, the status of an instance that stands by."""
        return f"{self.base}/standby/{check_name('instance', instance)}"

    @property
    def alive_any(self) -> str:
        """Matches the liveliness of every instance that serves this axis."""
        return f"{self.base}/alive/*"

    def alive(self, instance: str) -> str:
        """Liveliness of one instance; declared last, so alive means callable."""
        return f"{self.base}/alive/{check_name('instance', instance)}"
