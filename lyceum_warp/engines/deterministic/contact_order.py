"""Sort contacts and constraint rows, because their order varies between runs of MuJoCo Warp 4.0 on a GPU."""

import dataclasses
from collections.abc import Callable

import mujoco_warp as mjw
import warp as wp

from lyceum_warp.engines.deterministic import order_kernels as order
from lyceum_warp.support.arrays import alias

_LANES = 8


class CanonicalOrder:
    """Sorts a Data's contacts and constraint rows in every forward pass, through MuJoCo Warp's callbacks.

    MuJoCo Warp's own deterministic mode makes sums of atomic additions reproducible, but does not sort contacts and
    rows. The function ``between`` is called before each sort.

    Raises:
        ValueError: The model has flexes, or MuJoCo Warp's contacts have an unknown field.
    """

    def __init__(self, model: mjw.Model, data: mjw.Data, between: Callable[[], None] = lambda: None) -> None:
        self._between = between
        if model.nflex > 0:
            raise ValueError("deterministic=True can't sort the contacts of flexes: use engine='mujoco'")
        self._contacts, self._sorted_contacts = order.Contacts(), order.Contacts()
        for field in dataclasses.fields(data.contact):
            if field.name not in order.Contacts.vars:  # type: ignore[attr-defined]
                raise ValueError(
                    f"deterministic=True does not know the contact field {field.name!r} of this mujoco_warp: "
                    "install mujoco-warp 4.0"
                )
            words = _words(getattr(data.contact, field.name))
            setattr(self._contacts, field.name, words)
            setattr(self._sorted_contacts, field.name, wp.empty_like(words))
        self._rows, self._sorted_rows = order.Rows(), order.Rows()
        for name in order.Rows.vars:  # type: ignore[attr-defined]
            array = getattr(data.efc, name)
            setattr(self._rows, name, array)
            if name == "J" and model.is_sparse:
                array = wp.empty((0, 0, 0), dtype=float)
            elif name != "jtdaj_nblock":
                array = wp.empty_like(array)
            setattr(self._sorted_rows, name, array)
        self._key = wp.empty(2 * data.naconmax, dtype=wp.int64)
        self._place = wp.empty(2 * data.naconmax, dtype=int)
        self._rank = wp.empty((data.nworld, data.njmax), dtype=int)
        model.callback.contactfilter = self.sort_contacts
        model.callback.passive = self.sort_rows

    def sort_contacts(self, model: mjw.Model, data: mjw.Data) -> None:
        """Sort the contacts; MuJoCo Warp calls this after collision detection."""
        self._between()
        n, count = data.naconmax, data.nacon
        wp.launch(order.contact_keys, n, [count, self._contacts, n, self._key, self._place])
        wp.utils.radix_sort_pairs(self._key, self._place, n)
        args = [self._contacts, self._sorted_contacts]
        wp.launch(order.gather_contacts, n, [count, self._place, True, n, *args])
        wp.launch(order.gather_contacts, n, [count, self._place, False, n, *args[::-1]])

    def sort_rows(self, model: mjw.Model, data: mjw.Data) -> None:
        """Sort the constraint rows of every world; MuJoCo Warp calls this in the velocity stage."""
        self._between()
        nrow, shape = data.nefc, self._rank.shape
        wp.launch(order.rank_rows, shape, [nrow, model.eq_type, self._rows, self._rank])
        args = [self._rows, self._sorted_rows]
        for sort in (True, False):
            wp.launch(order.move_rows, (*shape, _LANES), [nrow, self._rank, sort, model.is_sparse, _LANES, *args])
            args.reverse()
        n = data.naconmax
        wp.launch(order.move_addresses, (n, data.contact.efc_address.shape[1]), [
            data.nacon, self._rank, n, self._contacts,
        ])  # fmt: skip


def _words(array: wp.array) -> wp.array:
    """Return a view of a contact field as 32-bit words, (naconmax, words)."""
    rows = array.shape[0] if array.ndim else 0
    size = array.size * wp.types.type_size_in_bytes(array.dtype) // 4
    if not rows or not size:
        return wp.empty((0, 0), dtype=int, device=array.device)
    return alias(array, int, (rows, size // rows))
