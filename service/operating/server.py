"""Takes the requests of operators from the wire, one after the other, and replies to each."""

from __future__ import annotations

import contextlib
import errno
import json
import os
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import zenoh

from dehyst.adaptive.errors import DehystError
from dehyst.service.operating.verbs import MAX_BYTES, Outcome, Request, Verb, decode_request
from dehyst.service.protocol.container import JSON, fields_of, to_json
from dehyst.service.protocol.errors import FieldError, ServiceError, error_to_json
from dehyst.service.protocol.keys import Keys
from dehyst.service.security.authenticator import NO_KEY, Authenticator
from dehyst.service.storage.output import append_line

# --- The journal of operations: one JSON line per operation in a folder of the axis.

FILE: Final = "operations.jsonl"
FILE_BEFORE: Final = "operations.1.jsonl"
FREEZE, THAW = "freeze", "thaw"
#: Verbs that change the model other than by samples: standbys must take them too.
_TOLD: Final = (FREEZE, THAW, "select", "rollback")
#: Beside the journal: a file whose room on the disk the journal takes when the disk is full, and its size, bytes.
RESERVE: Final = ".operations-reserve"
_RESERVE_BYTES: Final = 65_536
#: Size, bytes, beyond which the journal is renamed to operations.1.jsonl and a new one is started.
JOURNAL_BYTES: Final = 8 * 2**20


@dataclass(frozen=True, slots=True)
class Switch:
    """A *freeze* or *thaw* in the journal.

    Attributes
    ----------
    verb, who : as in the request. samples : count of all samples handled before it held. time_unix_s : of the entry, s.
    instance : the process that wrote it.
    """

    verb: str
    who: str
    samples: int
    time_unix_s: float
    instance: str = ""

    @property
    def freezes(self) -> bool:
        """Whether it is a *freeze*."""
        return self.verb == FREEZE

    def is_in(self, samples: int, time_unix_s: float, instance: str) -> bool:
        """Whether a state of the same axis, copied after ``samples`` by ``instance``, was copied after it.

        In one process the counts of samples tell it, whatever the clock does; between two the time does.
        """
        if self.instance and self.instance == instance and self.samples != samples:
            return self.samples < samples
        return self.time_unix_s < time_unix_s


class Journal:
    """Appends operations. Never raises: with a full disk an operator must still be able to freeze an axis.

    Parameters
    ----------
    folder : of ``operations.jsonl``; None: nothing is written.
    wall_s : returns the time, s since 1970. max_bytes : size at which a new file is started.
    """

    def __init__(
        self, folder: Path | None, wall_s: Callable[[], float] = time.time, max_bytes: int = JOURNAL_BYTES
    ) -> None:
        self.path = None if folder is None else folder / FILE
        #: Operations that could not be written.
        self.lost = 0
        self._wall_s = wall_s
        self._max_bytes = max_bytes

    def write(self, entry: Mapping[str, Any]) -> bool:
        """Append ``entry`` with the time and sync it to the disk; False if that failed."""
        if self.path is None:
            return True
        line = json.dumps({"time_unix_s": self._wall_s(), **entry}, default=str).encode() + b"\n"
        try:
            if self.path.exists() and self.path.stat().st_size + len(line) > self._max_bytes:
                self.path.replace(self.path.with_name(FILE_BEFORE))
            try:
                append_line(self.path, line)
            except OSError as error:
                # A full disk: a freeze must outlive the process all the same.
                if error.errno not in (errno.ENOSPC, errno.EDQUOT) or not self._release():
                    raise
                append_line(self.path, line)
        except OSError:
            self.lost += 1
            return False
        self.reserve()
        return True

    def reserve(self) -> None:
        """Keep room on the disk for operations, as long as there is some."""
        if self.path is None:
            return
        path = self.path.with_name(RESERVE)
        with contextlib.suppress(OSError):
            if path.exists():
                return
            path.parent.mkdir(parents=True, exist_ok=True)
            try:
                # Not zeros, which some file systems do not store.
                path.write_bytes(os.urandom(_RESERVE_BYTES))
            except OSError:
                path.unlink(missing_ok=True)

    def _release(self) -> bool:
        assert self.path is not None
        try:
            self.path.with_name(RESERVE).unlink()
        except OSError:
            return False
        return True

    def last_switch(self) -> Switch | None:
        """The last *freeze* or *thaw* that was applied; None if there is none. Damaged lines are skipped."""
        if self.path is None:
            return None
        for path in (self.path, self.path.with_name(FILE_BEFORE)):
            try:
                lines = path.read_bytes().splitlines()
            except OSError:
                continue
            for line in reversed(lines):
                entry = fields_of(line)
                verb, who = entry.get("verb"), entry.get("who")
                at_s, samples = entry.get("time_unix_s"), entry.get("samples", 0)
                if verb not in (FREEZE, THAW) or entry.get("ok") is not True:
                    continue
                if isinstance(who, str) and isinstance(at_s, float | int) and isinstance(samples, int):
                    return Switch(str(verb), who, samples, float(at_s), str(entry.get("instance", "")))
        return None


# --- The server.

SCHEMA: Final = 1
#: Requests that may wait; further ones are refused.
_WAITING: Final = 32
_STOP: Final = None


class OperationsServer:
    """The queryable ``.../operate`` of one axis and the thread behind it.

    It has a thread of its own, because a verb waits until the learner has finished its batch, and a callback of zenoh
    that waits would delay every query.

    Parameters
    ----------
    keys, instance : of the axis. verbs : the commands, by name. journal : keeps a record of them.
    note : notes an event: name, detail. role : present role of this instance; only a primary takes commands.
    samples : count of all samples when the last command was applied.
    tell : has the standbys take the state of a verb that changes it; returns how many hold it.
    settle : waits until a checkpoint of the last command is on the disk; False if it is not.
    background : verbs that start work and do not wait for it; the others note their own events.
    replayed : whether a start applies the last command of the journal, so that one in the journal is durable.
    authenticator : signs the answers, and tells the requests that carry the key.
    """

    def __init__(
        self,
        keys: Keys,
        instance: str,
        verbs: Mapping[str, Verb],
        journal: Journal,
        note: Callable[[str, str], None],
        role: Callable[[], str] = lambda: "primary",
        samples: Callable[[], int] = lambda: 0,
        tell: Callable[[], int] = lambda: 0,
        settle: Callable[[], bool] = lambda: False,
        background: Collection[str] = (),
        replayed: bool = True,
        authenticator: Authenticator = NO_KEY,
    ) -> None:
        self._by = authenticator
        self._keys = keys
        self._instance = instance
        self._verbs = verbs
        self._background = background
        self._journal = journal
        self._note = note
        self._role = role
        self._samples = samples
        self._tell = tell
        self._settle = settle
        #: Requests refused before they were read, which the thread writes to the journal: (payload, reason); and how
        #: many more there were than it keeps.
        self._turned_away: deque[tuple[bytes, str]] = deque()
        self._more_turned_away = 0
        self._counting = threading.Lock()
        self._replayed = replayed
        self._counts = {"done": 0, "refused": 0, "unsigned": 0}
        self._queue: queue.Queue[tuple[zenoh.Query, bytes | None] | None] = queue.Queue(_WAITING)
        self._thread: threading.Thread | None = None

    def counters(self) -> dict[str, int]:
        """For the status: requests done, refused, and without the key; operations missing in the journal."""
        return {**self._counts, "unlogged": self._journal.lost}

    def declare(self, session: zenoh.Session) -> list[Any]:
        """Take requests from now on; returns what is to be undeclared, in this order."""
        self._queue = queue.Queue(_WAITING)
        self._journal.reserve()
        self._thread = threading.Thread(
            target=self._run, args=(self._queue,), name=f"operate-{self._keys.axis}", daemon=True
        )
        self._thread.start()
        return [session.declare_queryable(self._keys.operate, self._on_query), self]

    def undeclare(self) -> None:
        """End the thread after the requests that wait; undeclare the queryable before."""
        if self._thread is not None:
            self._queue.put(_STOP)
            self._thread.join()
            self._thread = None

    def check(self, query: zenoh.Query) -> None:
        """Refuse a request without the authenticator of this service, or with one that came before: InputError."""
        if self._by.is_asked_by_ours(query, self._keys.operate):
            return
        if not self._counts["unsigned"]:
            detail = "a request without the authenticator of this service is refused; later ones are only counted"
            self._note("operation_refused", detail)
        self._counts["unsigned"] += 1
        got = "none" if query.attachment is None else "a wrong one, or one that came before"
        advice = "name the service's key (--key, DEHYST_KEY); see docs/access.md"
        raise FieldError("authenticator", got, "one by the key of this service, new for each request", advice)

    def handle(self, payload: bytes | None) -> bytes:
        """Run the command in a payload and record it; returns the reply. Raises DehystError if it is refused."""
        request: Request | None = None
        try:
            request = decode_request(payload)
            if self._role() != "primary":
                raise ServiceError(f"instance {self._instance} is a {self._role()}: only a primary takes commands")
            seq, result = self._apply(request)
        except Exception as error:
            self._counts["refused"] += 1
            if request is not None:
                self._write(request, error=str(error))
            if not isinstance(error, DehystError):
                self._note("internal_error", f"{self._keys.operate}: {type(error).__name__}: {error}")
            raise
        self._counts["done"] += 1
        journaled = self._write(request, seq=seq) and self._replayed
        standbys = self._tell() if request.verb in _TOLD else 0
        settled = request.verb not in self._background and self._settle()
        return to_json(
            {
                "schema": SCHEMA,
                "ok": True,
                "verb": request.verb,
                "who": request.who,
                "stage": self._keys.stage,
                "axis": self._keys.axis,
                "instance": self._instance,
                "seq": seq,
                "durable": journaled or settled,
                "standbys": standbys,
                "result": result,
            }
        )

    def _apply(self, request: Request) -> Outcome:
        verb = self._verbs.get(request.verb)
        if verb is None:
            raise FieldError("verb", repr(request.verb), f"one of {', '.join(self._verbs)}")
        try:
            return verb(request)
        except DehystError:
            raise
        except OSError as error:
            raise ServiceError(f"{request.verb}: {error}") from error

    def _write(self, request: Request, seq: int | None = None, error: str = "") -> bool:
        """Write to the journal, and note an event if the verb itself does not. Whether the entry is on the disk."""
        entry: dict[str, Any] = {
            "who": request.who,
            "verb": request.verb,
            "arguments": dict(request.arguments),
            "instance": self._instance,
            "ok": not error,
        }
        entry |= {"error": error} if error else {"seq": seq, "samples": self._samples()}
        lost = self._journal.lost
        written = self._journal.write(entry)
        if not written and not lost:
            self._note("journal_failed", f"{self._journal.path} cannot be written; operations go on, see the status")
        if error:
            self._note("operation_refused", f"{request.who}: {request.verb[:32]}: {error}"[:300])
        elif request.verb in self._background:
            self._note("operation", f"{request.who}: {request.verb} {json.dumps(dict(request.arguments))}"[:300])
        return written and self._journal.path is not None

    def _write_turned_away(self) -> None:
        """Write the requests that were refused because too many waited."""
        while self._turned_away:
            payload, error = self._turned_away.popleft()
            with contextlib.suppress(DehystError):
                self._write(decode_request(payload), error=error)
        with self._counting:
            more, self._more_turned_away = self._more_turned_away, 0
        if more:
            error = f"{more} more requests while {_WAITING} waited: only their number is kept"
            self._journal.write({"verb": "", "instance": self._instance, "ok": False, "error": error})

    def _on_query(self, query: zenoh.Query) -> None:
        # Refused before its bytes are copied.
        if query.payload is not None and len(query.payload) > MAX_BYTES:
            self._refuse(query, FieldError("payload", f"{len(query.payload)} bytes", f"at most {MAX_BYTES} bytes"))
            return
        try:
            self.check(query)
        except DehystError as unsigned:
            return _reply_error(query, unsigned)
        try:
            payload = None if query.payload is None else query.payload.to_bytes()
            self._queue.put_nowait((query, payload))
        except queue.Full:
            error = ServiceError(f"{_WAITING} requests wait already: ask again later")
            if len(self._turned_away) >= _WAITING:
                with self._counting:
                    self._more_turned_away += 1
            elif payload is not None:
                self._turned_away.append((payload, str(error)))
            self._refuse(query, error)
        except Exception as error:
            self._refuse(query, error)

    def _refuse(self, query: zenoh.Query, error: BaseException) -> None:
        self._counts["refused"] += 1
        _reply_error(query, error)

    def _run(self, waiting: queue.Queue[tuple[zenoh.Query, bytes | None] | None]) -> None:
        while (item := waiting.get()) is not _STOP:
            query, payload = item
            # Leaving the context finishes the query; otherwise the caller waits until its time is over.
            with query:
                try:
                    key, answer = self._keys.operate, self.handle(payload)
                    query.reply(key, answer, encoding=JSON, attachment=self._by.answered(query, key, answer))
                except zenoh.ZError:
                    continue  # the caller is gone
                except Exception as error:
                    query.reply_err(error_to_json(error), encoding=JSON)
            self._write_turned_away()


def _reply_error(query: zenoh.Query, error: BaseException) -> None:
    with query:
        query.reply_err(error_to_json(error), encoding=JSON)
