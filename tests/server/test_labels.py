"""The labels of a segment's entities are the same whether they were kept, added to, or encoded anew."""

import random
from typing import Any

from server.replication.labels import ATTRIBUTE_BYTES, Labels, ids_of, keys_of
from shared import messages

SEGMENT = (1, 2, 3)


def test_the_field_of_a_segment_is_the_same_as_without_any_memory() -> None:
    rng = random.Random(4)
    attributes: dict[int, dict[str, Any]] = {}
    labels, here, newest = Labels(attributes, ()), list[int](), 0
    for _ in range(400):
        act = rng.random()
        if act < 0.6:  # an entity comes, mostly a new one
            newest += 1
            here.append(newest)
            if rng.random() < 0.8:
                attributes[newest] = {"name": f"player {newest}"}
        elif act < 0.8 and here:  # one leaves the segment, and may come back
            here.remove(left := rng.choice(here))
            if rng.random() < 0.3:
                assert_same(labels, attributes, here)
                here = sorted([*here, left])
        elif here:  # the attributes of one change
            attributes[changed := rng.choice(here)] = {"score": rng.randint(0, 9)}
            labels.forget(changed)
        assert_same(labels, attributes, here)


def assert_same(labels: Labels, attributes: dict[int, dict[str, Any]], here: list[int]) -> None:
    keys = keys_of(here)
    assert list(ids_of(keys)) == here
    parts = [part for entity in here if entity in attributes for part in (entity, attributes[entity])]
    expected: tuple[bytes, list[int]] = (messages.pack(parts) if parts else b""), []
    assert labels.of_segment(SEGMENT, keys) == labels.of_segment(SEGMENT, keys) == expected


def test_labels_that_do_not_fit_are_named_each_time() -> None:
    ids = list(range(1, 200))
    labels = Labels({entity: {"text": "x" * 240} for entity in ids}, ())
    few = labels.of_segment(SEGMENT, keys_of(ids[:100]))
    assert few[1] == []
    field, others = labels.of_segment(SEGMENT, keys_of(ids))
    assert len(field) <= ATTRIBUTE_BYTES
    assert others == ids[-len(others) :]
    assert labels.of_segment(SEGMENT, keys_of(ids)) == (field, others)
    assert labels.of_segment(SEGMENT, keys_of(ids[:100])) == few
