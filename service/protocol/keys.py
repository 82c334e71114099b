"""Zenoh keys: ``dehyst/v1/{stage}/{axis}/{what}``. The version in the key changes with the format."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

from dehyst.service.protocol.errors import FieldError

ROOT = "dehyst/v1"
#: A name in a key: lower case, digits, underscore and hyphen, beginning with a letter, at most 64 characters.
_NAME = re.compile(r"[a-z][a-z0-9_-]{0,63}\Z")
#: The model name that stands for the best of the competing models.
AUTO: Final = "auto"


def check_name(field: str, name: object) -> str:
    """``name``. Raises InputError with ``field`` if the name cannot be part of a key."""
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
    """The keys of one axis. Raises InputError if a name cannot be part of a key."""

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
        """Publication of the stage: its samples."""
        return f"{self.base}/sample"

    @property
    def command(self) -> str:
        """Publication of the controller: voltages by sample number, in advance."""
        return f"{self.base}/command"

    @property
    def reference(self) -> str:
        """Publication of the controller: desired motion by sample number, for diagnostics."""
        return f"{self.base}/reference"

    @property
    def feedforward(self) -> str:
        """Query: desired trajectory -> voltages."""
        return f"{self.base}/feedforward"

    @property
    def model(self) -> str:
        """Query and publication: the learnt model."""
        return f"{self.base}/model"

    @property
    def champion(self) -> str:
        """Publication: the best of the competing models."""
        return f"{self.base}/champion"

    @property
    def model_delta(self) -> str:
        """Publication: changes of the learnt model."""
        return f"{self.base}/model_delta"

    @property
    def champion_delta(self) -> str:
        """Publication: changes of the best of the competing models."""
        return f"{self.base}/champion_delta"

    @property
    def status(self) -> str:
        """Query and publication, 1 Hz: JSON."""
        return f"{self.base}/status"

    @property
    def event(self) -> str:
        """Publication: JSON, one event."""
        return f"{self.base}/event"

    @property
    def diagnostics(self) -> str:
        """Publication, 20 Hz while somebody subscribes: JSON, quantities of the learner."""
        return f"{self.base}/diagnostics"

    @property
    def operate(self) -> str:
        """Query: a command of the operator, JSON."""
        return f"{self.base}/operate"

    @property
    def state(self) -> str:
        """Query of a standby: a checkpoint of the present state of the serving instance."""
        return f"{self.base}/state"

    @property
    def switch(self) -> str:
        """Query of the instance that serves after an operator's verb: a standby answers once it holds the new state."""
        return f"{self.base}/switch"

    def tokens(self, kind: str) -> str:
        """Matches the liveliness tokens of one kind, see `service.security.tokens`."""
        return f"{self.base}/{kind}/**"

    def token(self, kind: str, name: str, tag: str = "") -> str:
        """Liveliness: a claim to serve (``claim``), or a controller (``owner``). ``tag`` : "" without a key."""
        key = f"{self.base}/{kind}/{name}"
        return f"{key}/{tag}" if tag else key

    def standby(self, instance: str) -> str:
        """Liveliness, and publication 1 Hz: JSON, the status of a standby."""
        return f"{self.base}/standby/{check_name('instance', instance)}"

    def alive(self, instance: str) -> str:
        """Liveliness of one instance; declared last: an alive instance answers queries."""
        return f"{self.base}/alive/{check_name('instance', instance)}"
