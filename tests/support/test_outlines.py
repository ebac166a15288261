import dataclasses
import typing

import pytest

import lyceum_warp as lw
from lyceum_warp.support.docstrings import attribute_docs
from lyceum_warp.support.outlines import outline


@pytest.mark.parametrize("kind", [lw.NPGConfig, lw.PPOConfig, lw.SACConfig])
def test_outline_has_the_fields_defaults_and_docstrings_of_the_class(kind: type) -> None:
    copy = outline("lyceum_warp.algos", kind.__name__)
    assert copy is not kind and typing.get_type_hints(copy) == typing.get_type_hints(kind)
    defaults = [{field.name: field.default for field in dataclasses.fields(one)} for one in (copy, kind)]
    assert defaults[0] == defaults[1] and attribute_docs(copy) == attribute_docs(kind)
