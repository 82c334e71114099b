"""Instances of a service prove to each other that they belong together: by a secret that only they know.

An instance gives up serving, or continues from a state, because another one says so. Whoever reaches the wire could
say it. With a secret every claim is signed, a state is sent to nobody and taken from nobody without a proof, and a
proof is bound to a number chosen at random by who asks. Whoever listens can repeat a proof: who receives one takes its
number once (`Nonces`). Signatures are keyed BLAKE2b.
"""

from __future__ import annotations

import contextlib
import hashlib
import hmac
import os
import secrets
import threading
from collections import OrderedDict
from pathlib import Path
from typing import Final

from service.protocol.errors import FieldError

#: Name of the secret that is made where the configuration names none and all endpoints are of this machine.
OWN_SECRET: Final = ".dehyst-peers"
#: Fewest and most bytes of a secret.
_LEAST, _MOST = 16, 64
#: Bytes of a signature; as hexadecimal digits on the wire.
_SIGNATURE: Final = 16
SIGNATURE_DIGITS: Final = 2 * _SIGNATURE
#: Numbers of proofs that are remembered, and longest one.
_REMEMBERED: Final = 65_536
_LONGEST_NONCE: Final = 64


class PeerSecret:
    """The secret of a service's instances; ``secret`` empty: nothing is signed, and everything is believed."""

    def __init__(self, secret: bytes = b"") -> None:
        self._secret = secret

    def __bool__(self) -> bool:
        return bool(self._secret)

    def sign(self, *parts: object) -> str:
        """32 hexadecimal digits that only who knows the secret can make for ``parts``; "" without a secret."""
        if not self._secret:
            return ""
        text = b"".join(len(part).to_bytes(8, "little") + part for part in map(_bytes, parts))
        return hashlib.blake2b(text, key=self._secret, digest_size=_SIGNATURE).hexdigest()

    def proves(self, signature: str, *parts: object) -> bool:
        """Whether ``signature`` is that of ``parts``; always without a secret."""
        return not self._secret or hmac.compare_digest(signature.encode(), self.sign(*parts).encode())


def _bytes(part: object) -> bytes:
    return bytes(part) if isinstance(part, bytes | bytearray | memoryview) else str(part).encode()


def new_secret() -> PeerSecret:
    """A secret that nobody else knows."""
    return PeerSecret(secrets.token_bytes(_MOST))


def new_nonce() -> str:
    """A random number that cannot be predicted, as text."""
    return secrets.token_hex(16)


class Nonces:
    """The numbers of the proofs that were taken, so that a proof that somebody repeats is none. Any thread may ask.

    Give it numbers of right proofs only: a stranger must not fill it.
    """

    def __init__(self, remembered: int = _REMEMBERED) -> None:
        self._remembered = remembered
        self._taken: OrderedDict[str, None] = OrderedDict()
        self._lock = threading.Lock()

    def is_new(self, nonce: str) -> bool:
        """Whether ``nonce`` comes for the first time; it is taken then."""
        with self._lock:
            if nonce in self._taken or len(nonce) > _LONGEST_NONCE:
                return False
            self._taken[nonce] = None
            if len(self._taken) > self._remembered:
                self._taken.popitem(last=False)
            return True


def read_secret(path: Path | None) -> PeerSecret:
    """The secret in a file; an empty one for None.

    The file called `OWN_SECRET` is made if it is missing; where its folder cannot be written, there is no secret.
    Raises InputError if another file is missing, or if a secret is too short, too long or open to other users.
    """
    if path is None:
        return PeerSecret()
    if path.name == OWN_SECRET and not path.exists():
        try:
            _make(path)
        except OSError:
            return PeerSecret()
    advice = f"write {_LEAST} to {_MOST} random bytes into it, readable by the service's user only (mode 600)"
    try:
        secret = path.read_bytes().strip()
        mode = path.stat().st_mode & 0o077
    except OSError as error:
        raise FieldError("peer_secret", f"{path}: {error.strerror or error}", "a file with a secret", advice) from error
    if not _LEAST <= len(secret) <= _MOST:
        raise FieldError("peer_secret", f"{len(secret)} bytes in {path}", f"{_LEAST} to {_MOST} bytes", advice)
    if mode:
        raise FieldError("peer_secret", f"{path} with mode {mode:03o} for others", "a file of mode 600", advice)
    return PeerSecret(secret)


def _make(path: Path) -> None:
    """Write a new secret; of two instances that begin together the first one's counts."""
    part = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
    descriptor = os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
    try:
        with os.fdopen(descriptor, "wb") as file:
            file.write(secrets.token_hex(24).encode())
            file.flush()
            os.fsync(file.fileno())
        with contextlib.suppress(FileExistsError):
            os.link(part, path)
    finally:
        part.unlink(missing_ok=True)
