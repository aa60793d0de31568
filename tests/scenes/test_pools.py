"""Parts of rooms, dealt to pools and loaded."""

from __future__ import annotations

import dataclasses

from hypothesis import given
from hypothesis import strategies as st

from tdanet_jax.scenes import SceneTables, pools
from tdanet_jax.scenes.pools import Part
from tdanet_jax.scenes.tabulation import Progress


def unused(_: Progress) -> SceneTables:
    raise AssertionError


@given(
    st.lists(st.integers(1, 100), max_size=5), st.lists(st.integers(80, 90)), st.integers(1, 400)
)
def test_every_part_is_dealt_once_and_pools_are_about_equal(
    some: list[int], others: list[int], most: int
) -> None:
    parts = [Part(count, unused) for count in (*some, *others)]
    dealt = pools.deal(parts, most)
    assert sorted(p.rooms for pool in dealt for p in pool) == sorted(p.rooms for p in parts)
    lengths = [len(pool) for pool in dealt]
    assert not parts or max(lengths) - min(lengths) <= 1
    if sum(part.rooms for part in parts) <= most:
        assert dealt == ([parts] if parts else [])
    elif len(parts) > 1:
        assert len(dealt) > 1
    # No pool is larger than asked for by more than a part and what parts differ by.
    equal = pools.deal([Part(10, unused)] * 12, 10 * max(1, most // 10))
    assert max(sum(part.rooms for part in pool) for pool in equal) <= max(10, most)


def test_kinds_of_rooms_are_spread_over_the_pools() -> None:
    parts = [*[Part(80, unused)] * 4, *[Part(100, unused)] * 6]
    counts = [[part.rooms for part in pool] for pool in pools.deal(parts, 500)]
    assert counts == [[80, 80, 100, 100, 100]] * 2


def test_a_pool_is_joined_and_reports_over_all_of_its_parts(ithor: SceneTables) -> None:
    told: list[tuple[float, int]] = []

    def part(names: tuple[str, ...]) -> Part:
        def load(progress: Progress) -> SceneTables:
            progress(0.5, len(names))
            progress(len(names), len(names))
            tables = ithor.subset(names)
            return dataclasses.replace(tables, scenes=tuple(f"{name}-v01" for name in names))

        return Part(len(names), load)

    pool = [part(("FloorPlan1", "FloorPlan201")), part(("FloorPlan301",))]
    tables = pools.load(pool, ithor.classes, lambda done, total: told.append((done, total)))
    assert tables.scenes == ("FloorPlan1-v01", "FloorPlan201-v01", "FloorPlan301-v01")
    assert told == [(0, 3), (0.5, 3), (2, 3), (2, 3), (2.5, 3), (3, 3)]
    assert pools.load(pool, ithor.classes).data_version == tables.data_version
