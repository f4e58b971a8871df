"""The vocabulary of verdicts."""

from __future__ import annotations

from typing import get_args

import pytest
from epigauge import verdicts
from epigauge.verdicts import FLAGS


def test_every_flag_has_a_sentence_and_a_remedy_for_people() -> None:
    for name, flag in FLAGS.items():
        assert name == name.lower()
        for text in (flag.sentence, flag.remedy):
            assert len(text) > 20
            assert not text.endswith(".")  # `explained` puts it
        assert set(flag.spoils) <= set(get_args(verdicts.Kind))
        assert verdicts.explained([name])[name].count(". ") >= 1


def test_flags_are_listed_once_in_the_order_of_the_vocabulary() -> None:
    names = list(FLAGS)
    assert verdicts.ordered([*names[::-1], names[0]]) == tuple(names)
    with pytest.raises(KeyError, match="no such flag: planer scene"):
        verdicts.ordered(["planer scene"])


def test_a_result_is_usable_unless_a_flag_spoils_its_kind() -> None:
    assert verdicts.usable([], "F")
    assert verdicts.usable(["nearly planar", "few matches"], "F")
    assert not verdicts.usable(["few matches", "planar scene"], "F")
    assert verdicts.usable(["planar scene"], "E")
    for kind in ("F", "E", "views"):
        assert not verdicts.usable(["no common geometry"], kind)
