"""Sort contacts and constraint rows, because their order varies between runs of MuJoCo Warp 4.0 on a GPU."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import Any

import mujoco_warp as mjw
import warp as wp

from lyceum_warp.engines.deterministic import order_kernels as order
from lyceum_warp.support.arrays import alias

_LANES = 8

_ROWS = "type id pos margin D vel aref frictionloss".split()
_SPARSE_ROWS = "J_rownnz J_rowadr".split()
"""Fields of constraint rows. The entries of a sparse Jacobian do not move."""


class CanonicalOrder:
    """Sorts a Data's contacts and constraint rows in every forward pass, through MuJoCo Warp's callbacks.

    MuJoCo Warp's own deterministic mode makes sums of atomic additions reproducible, but does not sort contacts and
    rows. The function ``between`` is called before each sort.

    Raises:
        ValueError: The model has flexes.
    """

    def __init__(self, model: mjw.Model, data: mjw.Data, between: Callable[[], None] = lambda: None) -> None:
        self._between = between
        if model.nflex > 0:
            raise ValueError("deterministic=True can't sort the contacts of flexes: use engine='mujoco'")
        contacts = [getattr(data.contact, field.name) for field in dataclasses.fields(data.contact)]
        names = _ROWS + _SPARSE_ROWS if model.is_sparse else _ROWS
        rows = [getattr(data.efc, name) for name in names]
        jacobian = wp.empty((0, 0, 0), dtype=float) if model.is_sparse else data.efc.J
        self._contacts = _Scratch([_words(array) for array in contacts if array.size])
        self._rows = _Scratch([alias(array, int, array.shape) for array in rows])
        self._jacobian = jacobian, wp.empty_like(jacobian)
        blocks = data.efc.jtdaj_adr, data.efc.jtdaj_nrow
        self._blocks = blocks, tuple(map(wp.empty_like, blocks))
        self._key = wp.empty(2 * data.naconmax, dtype=wp.int64)
        self._place = wp.empty(2 * data.naconmax, dtype=int)
        self._rank = wp.empty((data.nworld, data.njmax), dtype=int)
        model.callback.contactfilter = self.sort_contacts
        model.callback.passive = self.sort_rows

    def sort_contacts(self, model: mjw.Model, data: mjw.Data) -> None:
        """Sort the contacts; MuJoCo Warp calls this after collision detection."""
        self._between()
        n, count, contact = data.naconmax, data.nacon, data.contact
        keys = [contact.worldid, contact.geom, contact.geomcollisionid]
        wp.launch(order.contact_keys, n, [count, *keys, n, self._key, self._place])
        wp.utils.radix_sort_pairs(self._key, self._place, n)
        for sort, fields in ((True, self._contacts.copies), (False, self._contacts.copies_back)):
            wp.launch(order.gather_contacts, (len(fields), n), [count, self._place, sort, fields])

    def sort_rows(self, model: mjw.Model, data: mjw.Data) -> None:
        """Sort the constraint rows of every world; MuJoCo Warp calls this in the velocity stage."""
        self._between()
        efc, address, shape = data.efc, data.contact.efc_address, self._rank.shape
        wp.launch(order.rank_rows, shape, [data.nefc, model.eq_type, efc.type, efc.id, self._rank])
        for sort, step in ((True, 1), (False, -1)):
            fields = self._rows.copies if sort else self._rows.copies_back
            args = [data.nefc, self._rank, sort, _LANES, fields, *self._jacobian[::step]]
            wp.launch(order.move_rows, (*shape, _LANES), args)
            if model.is_sparse:
                source, target = self._blocks[::step]
                blocks = [efc.jtdaj_nblock, self._rank, sort, *source, *target]
                wp.launch(order.move_blocks, efc.jtdaj_adr.shape, blocks)
        wp.launch(order.move_addresses, address.shape, [data.nacon, self._rank, data.contact.worldid, address])


class _Scratch:
    """Memory for copies of arrays, with the arguments of kernels that copy to this memory and back."""

    def __init__(self, arrays: Sequence[wp.array]) -> None:
        self.arrays = [(array, wp.empty_like(array)) for array in arrays]
        self.copies: wp.array = wp.array([_copy(*pair) for pair in self.arrays], dtype=order.Copy)
        self.copies_back: wp.array = wp.array([_copy(*pair[::-1]) for pair in self.arrays], dtype=order.Copy)


def _copy(source: wp.array, target: wp.array) -> Any:
    copy: Any = order.Copy()
    copy.source, copy.target = source, target
    return copy


def _words(array: wp.array) -> wp.array:
    """Return a view of a contact field as 32-bit words, (naconmax, words)."""
    rows = array.shape[0]
    return alias(array, int, (rows, array.size * wp.types.type_size_in_bytes(array.dtype) // 4 // rows))
