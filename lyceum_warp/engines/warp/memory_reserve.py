"""Memory that is allocated ahead of time, for allocators that hand out parts of it."""

import warp as wp

_ALIGNED = 512


class Reserve:
    """Blocks of memory on a device, with that part of Warp's protocol for allocators which frees memory.

    Blocks stay allocated as long as the reserve, because graphs hold their addresses.

    Args:
        device: The device.
    """

    def __init__(self, device: wp.Device) -> None:
        self.device = device
        self.below = device.get_allocator()
        """The device's allocator, for the blocks and for all memory that is not reserved."""
        self.blocks: list[wp.array] = []

    def add_block(self, size: int) -> None:
        """Allocate a block of at least so many bytes."""
        rows = aligned(max(size, 1)) // _ALIGNED  # an axis may be no longer than 2**31
        with wp.ScopedAllocator(self.device, self.below):
            self.blocks.append(wp.empty((rows, _ALIGNED), dtype=wp.uint8, device=self.device))

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        """Free an address, unless it lies in a block."""
        if not any(block.ptr <= ptr < block.ptr + block.size for block in self.blocks):
            self.below.deallocate(ptr, size_in_bytes)


def aligned(size: int) -> int:
    """A number of bytes, rounded up to a multiple of the alignment of addresses."""
    return -(-size // _ALIGNED) * _ALIGNED
