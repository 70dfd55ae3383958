"""The data plane in C (bridged/relay): one Relay moves the frames of one bridge."""

from typing import Final, Protocol, Self, final

from _typeshed import structseq

class _HasFileno(Protocol):
    def fileno(self) -> int: ...

GATE_AWAY: Final[int]  # frames from the interface are dropped: no adapter
GATE_OPEN: Final[int]  # frames from the interface are sent
GATE_LISTEN_ONLY: Final[int]  # dropped: the channel does not send
GATE_STOPPED: Final[int]  # dropped: the bridge is stopping
ACCEPT_OK: Final[int]
ACCEPT_REFUSED: Final[int]
EVENT_OK: Final[int]  # a command was answered "done"
EVENT_REFUSED: Final[int]  # a command was refused
EVENT_TEXT: Final[int]  # a command was answered with a text
EVENT_TIMEOUT: Final[int]  # a command was not answered in time, or the port went away before
EVENT_UNASKED: Final[int]  # a text that no command asked for
EVENT_NOISE: Final[int]  # bytes that are no message, before frames are received
EVENT_FRAME_REFUSED: Final[int]  # the adapter refused a frame; token: how many retries so far. Not at each
EVENT_UNANSWERED: Final[int]  # an answer is missing: the line is being resynchronised
EVENT_SILENT: Final[int]  # not even the sync command is answered; nothing is sent until a new attach
EVENT_STUCK: Final[int]  # no frame has left the device for `stuck`; token: how many are in it, 0: not known
EVENT_STAMPED: Final[int]  # a frame had a time stamp; said once per attach
EVENT_PORT_LOST: Final[int]  # token: errno, 0 for end of file
EVENT_INTERFACE_DOWN: Final[int]  # the interface is down
EVENT_INTERFACE_LOST: Final[int]  # token: errno, 0 for end of file
WINDOW_MAX: Final[int]

@final
class Tally(structseq[int], tuple[int, int, int, int, int, int, int]):
    """Some of the relay's counters, under the names that counters() has."""

    @property
    def decoded(self) -> int: ...
    @property
    def rx_frames(self) -> int: ...
    @property
    def tx_frames(self) -> int: ...
    @property
    def tx_queued(self) -> int: ...
    @property
    def tx_unconfirmed(self) -> int: ...
    @property
    def rx_overruns(self) -> int: ...
    @property
    def skipped_bytes(self) -> int: ...

class Relay:
    """Relays frames between a port (bytes) and an interface (datagrams of struct can_frame).

    Times are seconds. `window`: how many frames and commands may be unanswered. `deadline`: a frame
    older than this is not sent. `stuck`: EVENT_STUCK when no frame has left the device for so long.
    `sync`: a command whose answer, a text that begins with `sync_prefix`, cannot be taken for any other
    answer; sent to find the thread again after an answer was lost.
    Raises ValueError or OverflowError for what is out of range, OSError when descriptors or memory run out.
    A child made by fork() must leave the relays of its parent alone: a lock may be held in it for ever.
    """

    def __new__(
        cls,
        codec: str,
        *,
        queue: int,
        window: int,
        deadline: float,
        stuck: float,
        answer_timeout: float,
        sync: bytes,
        sync_prefix: bytes,
    ) -> Self: ...
    def run(self) -> None:
        """Relay until stop() is called, without the GIL. OSError(EBUSY): another thread does."""
    def turn(self, now: int, wall: int = 0, /) -> int | None:
        """One turn without waiting; the time of the next one (ns), None: on input. For tests.

        `now`, `wall` (0 to 2**62 ns): what the relay's clock and that of the time stamps show all the while.
        """
    def stop(self) -> None: ...
    def wake(self) -> None:
        """One turn, for nothing but to see that it turns (counter `turns`)."""
    def fileno(self) -> int:
        """Readable when events() has something."""
    def attach_port(self, fd: int | _HasFileno, /) -> None:
        """Talk to this non-blocking stream. Gates are closed: only commands go, frames are dropped.

        The relay uses a duplicate until it is detached; the caller closes its own, best after that: closing
        the last one of a terminal may take long. OSError: nothing is attached.
        """
    def detach_port(self) -> None: ...
    def cut(self) -> tuple[bool, bytes, int]:
        """After detach_port(): whether the device may not have read all frames; the message of which the port
        took a part (empty: none), and how many bytes of it."""
    def resume(self, message: bytes, taken: int, /) -> None:
        """After attach_port() of the same port: first the rest of the message of cut()."""
    def last_words(self, words: bytes, /) -> None:
        """Say this at once, behind the message that the port took in part; nothing else is sent any more."""
    def attach_interface(self, fd: int | _HasFileno, /) -> None:
        """Carry frames between the port and this socket; a duplicate and OSError as above."""
    def detach_interface(self) -> None: ...
    def hold_interface(self, held: bool, /) -> None:
        """While `held`, frames from the interface (or one attached later) wait unread; those to it go on."""
    def set_gates(self, *, receiving: bool, transmit: int) -> None:
        """Whether frames from the device go to the interface, and what happens to those from it."""
    def set_queue(self, queue: int, deadline: float, stuck: float, /) -> None:
        """All three anew; frames for which there is no room any more are dropped, the newest first."""
    def set_sync(self, sync: bytes, prefix: bytes, /) -> None:
        """Another sync command than that which the relay was made with."""
    def set_polling(self, request: bytes, prefix: bytes, interval: float, /) -> None:
        """Ask the device for frames with `request` until the port is detached."""
    def set_sending(
        self,
        confirms: str,
        remote: str,
        /,
        *,
        window: int,
        bitrate: int,
        depth: int,
        retries: bool,
        long_stamps: bool,
    ) -> None:
        """How the device wants its frames until the port is detached: adapters/base.py, `Sending`.

        `confirms`, `remote`: the values of Confirms and Remote. `window`: 0 for what the relay was made with.
        `bitrate`: 0 for frames that go as the answers come; else they go no faster than a bus of this rate
        takes them, at most `depth` at once in the device. `retries`: a refused frame is sent again.
        `long_stamps`: received frames may have time stamps of 8 digits.
        """
    def count_late(self, kept: int, /) -> None:
        """The last `kept` frames given to the device may leave it late: counts them, none twice."""
    def set_level_window(
        self, ask: bytes, prefix: bytes, /, *, capacity: int, critical: int, ready: int
    ) -> None:
        """For a device that does not answer frames: `ask` follows them, its answer confirms them.

        `capacity`, `critical`, `ready`: frames that its transmit buffer holds, and above and below which it
        says "stop" and "go". Until this is called no frame is sent; it ends when the port is detached.
        """
    def command(
        self, token: int, data: bytes, accept: int, prefix: bytes, timeout: float, *, more: bool = False
    ) -> None:
        """Send a command at the next message boundary; an event with `token` always follows.

        `more`: together with the next command, which follows at once.
        """
    def events(self) -> list[tuple[int, int, bytes]]:
        """What happened since the last call: (EVENT_…, token, text)."""
    def tally(self) -> Tally:
        """Some of the counters, for frequent looks."""

    def glimpse(self) -> tuple[bytes, bytes]:
        """A frame that came from the interface lately and one that went to it; zeros before there is one."""

    def counters(self) -> dict[str, int | dict[str, int]]:
        """A snapshot between two turns: bus_read = tx_frames + tx_queued + tx_unconfirmed + queued
        + the sum of tx_dropped."""

def decode(codec: str, pieces: list[bytes], /) -> list[tuple[str, bytes, int]]:
    """The messages of a stream that arrives in these pieces: (kind, frame or text, digits or length)."""

def encode(codec: str, frame: bytes, /) -> bytes:
    """The bytes for one struct can_frame; empty if the protocol cannot say it."""

def clock() -> int:
    """The relay's clock, ns: CLOCK_BOOTTIME."""

def meanings() -> dict[str, dict[str, str]]:
    """What each of `counters`, `events`, `tx_dropped` and `rx_dropped` means (relay/counters.h)."""
