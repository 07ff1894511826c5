"""docs/configuration.md has every key of the schema, as the schema has it now: `make reference` writes it."""

from __future__ import annotations

import re

import pytest

from docs import reference


def test_every_key_has_a_meaning() -> None:
    """A key that somebody adds is told of here by the error, with the place where its meaning belongs."""
    keys = [(section, name) for section in reference.sections() for name in section.model_fields]
    assert [name for section, name in keys if len(reference.meaning_of(section, name)) <= 5] == []


def test_no_meaning_is_of_a_key_that_is_gone() -> None:
    fields = {
        key: set(one.model_fields)
        for section in reference.sections()
        for one in section.__mro__
        if hasattr(one, "model_fields")
        for key in (one.__name__, f"{one.__module__}.{one.__name__}")
    }
    fields["anywhere"] = set().union(*fields.values())
    gone = {
        f"{key}.{name}"
        for key, meanings in reference.MEANINGS.items()
        for name in meanings
        if name not in fields.get(key, set())
    }
    assert gone == set()


def test_a_quantity_has_its_unit() -> None:
    """A number without one is a count, a share or a factor, and says so."""
    units = {
        reference.unit_of(section, name).removesuffix(" or `null`")
        for section in reference.sections()
        for name in section.model_fields
    }
    assert {"m", "kg", "rad", "N", "N/m", "N s/m", "kg m", "Pa s", "kg/m^3", "rpm", "Hz", "s"} <= units


@pytest.mark.slow
def test_the_page_is_what_the_schema_says() -> None:
    page = reference.PAGE.read_text(encoding="utf-8")
    assert page == reference.write(), "make reference"
    keys = {match for match in re.findall(r"^\| `(\w+)` \|", page, re.M)}
    fields = [entry for section in reference.sections() for entry in section.model_fields.items()]
    assert keys == {field.alias or name for name, field in fields}
