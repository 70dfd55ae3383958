"""What an adapter is: values that say what to send, what answers it, and what that means. No I/O."""

from __future__ import annotations

import enum
from collections.abc import Generator, Sequence
from typing import TYPE_CHECKING, Annotated, NamedTuple, Protocol

from msgspec import Meta

if TYPE_CHECKING:
    from bridged.can import BusState

# Keys that several types of adapter have. A description completes "expected …, got the text 'fast'".
TypeName = Annotated[str, Meta(description="the name of a type of adapter")]
PortText = Annotated[
    str, Meta(min_length=1, description="a device path like /dev/ttyUSB0 or a URL like socket://HOST:PORT")
]
Baudrate = Annotated[int, Meta(ge=50, le=4_000_000, description="a UART rate from 50 to 4000000 bit/s")]
SerialNumber = Annotated[
    str, Meta(pattern="^[!-~]{1,32}$", description="the serial number that the device reports")
]


class Reply(enum.Enum):
    """How a device can answer."""

    OK = enum.auto()
    REFUSED = enum.auto()
    TEXT = enum.auto()  # one that begins with Exchange.prefix
    NONE = enum.auto()  # nothing, until Exchange.timeout_s


class Exchange(NamedTuple):
    """One request and the answers it can have. An answer in neither tuple is somebody else's."""

    request: bytes
    purpose: str  # completes "the adapter refused to …", "the adapter did not answer the request to …"
    accept: tuple[Reply, ...]
    reject: tuple[Reply, ...] = (Reply.REFUSED, Reply.NONE)
    prefix: bytes = b""  # how the text that answers begins
    advice: str = ""  # what the user can do when it is rejected
    timeout_s: float = 0.5
    opens: bool = False  # the channel: frames that come from now on are received


def pause(seconds: float) -> Exchange:
    """A step that says nothing, and is answered by NONE when this time is over."""
    return Exchange(b"", "wait", (Reply.NONE,), (), timeout_s=seconds)


class Answer(NamedTuple):
    """What came back for an exchange."""

    reply: Reply
    text: bytes = b""


class Polling(NamedTuple):
    """A device that does not speak by itself is asked for frames this often."""

    request: bytes
    prefix: bytes
    interval_s: float


class Flow(NamedTuple):
    """How the window of a device works that does not answer frames: see Relay.set_level_window."""

    request: bytes
    prefix: bytes
    capacity: int  # these in frames of its transmit buffer
    critical: int
    ready: int


class Confirms(enum.Enum):
    """What a device's answer to a frame means. The values are those of Relay.set_sending()."""

    TAKEN = "taken"  # it is in a buffer which is emptied when the channel is closed: tx_frames
    SENT = "sent"  # it is on the bus: tx_frames
    QUEUED = "queued"  # it is in a buffer: tx_queued
    ALWAYS = "always"  # nothing, the device answers also where it loses the frame: tx_unconfirmed
    NOTHING = "nothing"  # the device answers no frame: tx_unconfirmed


class Remote(enum.Enum):
    """How a device wants a remote frame. The values are those of Relay.set_sending()."""

    PLAIN = "plain"
    WITH_DIGITS = "with-digits"  # with as many zeros behind it as a data frame of its DLC has digits
    NO_STANDARD = "no-standard"  # plain; one with a standard identifier cannot be sent
    NONE = "none"  # none can be sent


class Sending(NamedTuple):
    """How a device wants its frames; the defaults are those of a CAN232. See Relay.set_sending()."""

    confirms: Confirms = Confirms.TAKEN
    remote: Remote = Remote.PLAIN
    window: int | None = None  # frames and commands unanswered at once; None: as configured
    depth: int = 1  # frames in the device's own buffer at once, with `paced_bitrate`
    paced_bitrate: int | None = None  # bit/s: frames go no faster than a bus of this rate takes them
    retries: bool = True  # False: a refused frame may have been on the bus, so it is not sent again
    long_stamps: bool = False  # received frames may have time stamps of 8 digits
    keeps_buffer: bool = False  # closing the channel does not empty the buffer
    kept: int = 0  # how many frames such a buffer has room for


class Identity(NamedTuple):
    """Who the device says it is."""

    version: str | None = None
    serial_number: str | None = None
    firmware: str | None = None  # the name of its profile, where a type of adapter has several


class Happened(enum.Flag):
    """What can have happened since the last look."""

    NOTHING = 0
    TX_FULL = enum.auto()
    RX_OVERFLOW = enum.auto()
    ARBITRATION_LOST = enum.auto()
    BUS_ERROR = enum.auto()
    RESTARTED = enum.auto()


class Observation(NamedTuple):
    """What an adapter said of its bus. `state` None: it did not say; counters None: it cannot."""

    description: str
    state: BusState | None = None
    lasting: bool = True  # False: `state` is the worst there was since the last look, not what is now
    tec: int | None = None
    rec: int | None = None
    happened: Happened = Happened.NOTHING


UNKNOWN = Observation("unknown")
"""It did not answer."""


class Memory(Protocol):
    """What is known of a device's settings that it cannot be asked for, by serial number."""

    def recall(self, serial_number: str, setting: str) -> int | None: ...
    def remember(self, serial_number: str, setting: str, value: int) -> None: ...


Steps = Generator[Exchange, Answer, None]


class Adapter(Protocol):
    """One kind of device. bridge.py performs the steps, in order, each with its deadline."""

    codec: str
    baudrate: int  # of a serial line, bit/s
    sync: Exchange  # its answer cannot be taken for any other; after init_steps it may be another one
    answer_timeout_s: float  # for the answer to a frame
    identity: Identity
    polling: Polling | None  # known after init_steps, as is
    flow: Flow | None  # None: the device answers each frame
    sending: Sending  # known after init_steps, as are the next four
    sent_means: str | None  # a sentence: what the device vouches for when a frame counts as sent
    cautions: tuple[str, ...]  # what this device does otherwise than its user would think
    tells_full: bool  # whether its buffer is. False: every refusal of a frame may mean that
    stops: bool  # a closed channel is off its CAN bus
    discarded: int  # frames that it took and threw away, as far as it tells

    @property
    def last_words(self) -> bytes:
        """Closes the channel, where no time is left to await answers."""

    def init_steps(self, serial_number: str | None, product: str | None = None) -> Steps:
        """From whatever state to an open channel. Raises AdapterError for a device that will not do.

        `serial_number` and `product` are those of the USB device which is the port, None if it has none.
        """

    def close_steps(self, drain: bool) -> Steps:
        """From whatever state to a closed channel; the steps accept every answer.

        `drain`: what it has taken goes first; without it that is thrown away, since it may be too old.
        """

    def health_questions(self) -> tuple[Exchange, ...]:
        """To be asked at once, to know what the device thinks of its bus."""

    def read_health(self, answers: Sequence[Answer | None]) -> Observation | None:
        """What it answered, in the order of the questions; None: it takes the other answers to know.

        Called with the first answer, and with all. AdapterError: it must be initialised again.
        """

    def saw_time_stamps(self) -> None:
        """Frames with time stamps came, which nobody asked for."""

    def saw_noise(self, noise: bytes) -> None:
        """Bytes that mean nothing came while the adapter is being initialised."""

    def saw_text(self, text: bytes) -> None:
        """A text came that answers no request, while the adapter does not run."""

    def read_report(self, text: bytes) -> Observation | None:
        """What the device said unasked; None if there is nothing to it. AdapterError as read_health."""
