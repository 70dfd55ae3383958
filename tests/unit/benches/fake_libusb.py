"""A backend for pyusb that behaves as libusb with FT245 chips does."""

# ruff: noqa: ARG002 - pyusb calls with more than is needed here

from __future__ import annotations

import errno
import os
import queue
import threading
from array import array
from typing import TYPE_CHECKING, Any

from usb.backend import IBackend
from usb.core import USBError, USBTimeoutError

if TYPE_CHECKING:
    from collections.abc import Iterator


def usb_error(number: int) -> USBError:
    return USBError(os.strerror(number), -1, number)


class Descriptor:
    """Of any kind: what is not given is 0."""

    def __init__(self, **values: Any) -> None:
        self.__dict__.update(values)

    def __getattr__(self, name: str) -> int:
        return 0


class Chip:
    """An FT245 and what the kernel knows of it."""

    def __init__(self, serial_number: str = "A1", address: int = 4) -> None:
        self.serial_number = serial_number
        self.address = address
        self.endpoints = [0x81, 0x02]
        self.configuration = 1
        self.driver = True  # ftdi_sio has it
        self.opened = 0
        self.claimed = False
        self.refuse: dict[Any, int] = {}  # name of a call, or a request: its errno
        self.calls: list[Any] = []
        self.transfers: queue.Queue[bytes | USBError] = queue.Queue()  # to come from the chip
        self.written: queue.Queue[bytes] = queue.Queue()
        self.room: list[int] = []  # how much each of the next writes takes; then everything
        self.stuck = threading.Event()  # it takes no more bytes

    def call(self, what: Any) -> None:
        self.calls.append(what)
        if what in self.refuse:
            raise usb_error(self.refuse[what])


class FakeLibusb(IBackend):
    """As far as pyusb calls it. A device and its handle are the same thing."""

    def __init__(self, *chips: Chip) -> None:
        self.chips = chips

    def enumerate_devices(self) -> Iterator[Chip]:
        return iter(self.chips)

    def get_device_descriptor(self, dev: Chip) -> Descriptor:
        return Descriptor(
            idVendor=0x403,
            idProduct=0x6001,
            iSerialNumber=3,
            bNumConfigurations=1,
            bus=1,
            address=dev.address,
            port_number=dev.address,
            port_numbers=(dev.address,),
            speed=2,
        )

    def get_configuration_descriptor(self, dev: Chip, config: int) -> Descriptor:
        return Descriptor(bNumInterfaces=1, bConfigurationValue=1)

    def get_interface_descriptor(self, dev: Chip, intf: int, alt: int, config: int) -> Descriptor:
        if alt:
            raise IndexError
        return Descriptor(bNumEndpoints=len(dev.endpoints))

    def get_endpoint_descriptor(self, dev: Chip, ep: int, intf: int, alt: int, config: int) -> Descriptor:
        return Descriptor(bEndpointAddress=dev.endpoints[ep], bmAttributes=2, wMaxPacketSize=64)

    def open_device(self, dev: Chip) -> Chip:
        dev.call("open")
        dev.opened += 1
        return dev

    def close_device(self, dev_handle: Chip) -> None:
        dev_handle.opened -= 1

    def get_configuration(self, dev_handle: Chip) -> int:
        return dev_handle.configuration

    def set_configuration(self, dev_handle: Chip, config_value: int) -> None:
        dev_handle.call("set_configuration")
        dev_handle.configuration = config_value

    def is_kernel_driver_active(self, dev_handle: Chip, intf: int) -> bool:
        return dev_handle.driver

    def detach_kernel_driver(self, dev_handle: Chip, intf: int) -> None:
        dev_handle.call("detach")
        dev_handle.driver = False

    def attach_kernel_driver(self, dev_handle: Chip, intf: int) -> None:
        assert not dev_handle.claimed
        dev_handle.call("attach")
        dev_handle.driver = True

    def claim_interface(self, dev_handle: Chip, intf: int) -> None:
        assert not dev_handle.driver
        dev_handle.call("claim")
        dev_handle.claimed = True

    def release_interface(self, dev_handle: Chip, intf: int) -> None:
        dev_handle.claimed = False
        dev_handle.call("release")

    def ctrl_transfer(
        self,
        dev_handle: Chip,
        bmRequestType: int,  # noqa: N803 - pyusb's names
        bRequest: int,  # noqa: N803
        wValue: int,  # noqa: N803
        wIndex: int,  # noqa: N803
        data: array[int],
        timeout: int,
    ) -> int:
        assert timeout > 0
        if (bmRequestType, bRequest) == (0x80, 6):  # GET_DESCRIPTOR of a string
            text = dev_handle.serial_number.encode("utf-16-le") if wValue & 0xFF else b"\x09\x04"
            memoryview(data)[: len(text) + 2] = bytes([len(text) + 2, 3]) + text
            return len(text) + 2
        assert (bmRequestType, wIndex, len(data)) == (0x40, 0, 0)
        dev_handle.call((bRequest, wValue))
        return 0

    def bulk_read(self, dev_handle: Chip, ep: int, intf: int, buff: array[int], timeout: int) -> int:
        assert dev_handle.claimed
        assert ep == 0x81
        try:
            item = dev_handle.transfers.get(timeout=timeout / 1000)
        except queue.Empty:
            raise USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT) from None
        if isinstance(item, USBError):
            dev_handle.transfers.put(item)
            raise item
        memoryview(buff)[: len(item)] = item
        return len(item)

    def bulk_write(self, dev_handle: Chip, ep: int, intf: int, data: array[int], timeout: int) -> int:
        assert dev_handle.claimed
        assert ep == 0x02
        dev_handle.call("write")
        if dev_handle.stuck.is_set():
            threading.Event().wait(timeout / 1000)
            raise USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        n = min(len(data), dev_handle.room.pop(0)) if dev_handle.room else len(data)
        if n == 0:
            raise USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        dev_handle.written.put(data[:n].tobytes())
        return n
