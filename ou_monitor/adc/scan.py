"""
How an IIO buffer lays out one scan, and scans to volts.

The kernel's ABI (Documentation/ABI/testing/sysfs-bus-iio, iio_devbuf): an element is
`[be|le]:[s|u]bits/storagebits[>>shift]`, lies at a multiple of its own size, in the order of the
indices, and a scan is padded to a multiple of its largest element.  Volts are
(raw + offset) * scale / 1000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import re

import numpy as np
import numpy.typing as npt
from ou_monitor.errors import InputError
from ou_monitor.records import FloatArray

_TYPE = re.compile(r'(be|le):([su])(\d+)/(\d+)(?:X(\d+))?(?:>>(\d+))?')


@dataclass(frozen=True)
class Element:
    """
    One element of a scan.

    Attributes
    ----------
    name : str
        'in_voltage0', 'in_timestamp'.
    index : int
        Its place among the elements.
    order : str
        '<' or '>'.
    signed : bool
        Whether two's complement.
    bits, storage, shift : int
        Valid bits, bits in memory, and bits below the valid ones.

    """

    name: str
    index: int
    order: str
    signed: bool
    bits: int
    storage: int
    shift: int

    def integers(self, raw: npt.NDArray[np.unsignedinteger]) -> npt.NDArray[np.int64]:
        """Return the numbers in what is stored."""
        stored = raw.astype(np.uint64) >> np.uint64(self.shift)
        unused = np.uint64(64 - self.bits)
        # To the top and back: the sign is extended, or what is above masked out.
        top = stored << unused
        if self.signed:
            return top.view(np.int64) >> np.int64(unused)
        return (top >> unused).astype(np.int64)


def parse_element(name: str, index: int, kind: str) -> Element:
    """Return an element by its `_index` and `_type`."""
    match = _TYPE.fullmatch(kind)
    if match is None:
        raise InputError(f"{name}_type is '{kind[:40]}', not of the form le:s12/16>>4")
    order, sign, bits, storage, repeat, shift = match.groups(default='0')
    found = Element(name, index, '<' if order == 'le' else '>', sign == 's', int(bits),
                    int(storage), int(shift))
    if found.storage not in (8, 16, 32, 64) or int(repeat) > 1:
        raise InputError(f"{name}_type is '{kind}': 8, 16, 32 or 64 bits of storage, without "
                         'repetition, can be read')
    if not 0 < found.bits <= found.storage - found.shift:
        raise InputError(f"{name}_type is '{kind}': {found.bits} bits do not fit")
    return found


class Scan:
    """
    Layout of the scans of a buffer.

    Parameters
    ----------
    elements : sequence of Element
        Those that are enabled.

    Attributes
    ----------
    size : int
        Bytes in one scan.

    """

    def __init__(self, elements: Sequence[Element]) -> None:
        self._elements = {element.name: element for element in elements}
        at, offsets, largest = 0, [], 1
        ordered = sorted(elements, key=lambda element: element.index)
        for element in ordered:
            length = element.storage // 8
            at = -(-at // length) * length
            offsets.append(at)
            at += length
            largest = max(largest, length)
        self.size = -(-at // largest) * largest
        self._dtype = np.dtype({
            'names': [element.name for element in ordered], 'offsets': offsets,
            'formats': [f'{element.order}u{element.storage // 8}' for element in ordered],
            'itemsize': self.size})

    def integers(self, data: bytes, name: str) -> npt.NDArray[np.int64]:
        """Return the numbers of one element in whole scans."""
        return self._elements[name].integers(np.frombuffer(data, self._dtype)[name])

    def volts(self, data: bytes, name: str, scale: float, offset: float) -> FloatArray:
        """Return one element of whole scans in V (scale in mV, as the kernel gives it)."""
        return (self.integers(data, name).astype(np.float64) + offset) * (1e-3 * scale)
