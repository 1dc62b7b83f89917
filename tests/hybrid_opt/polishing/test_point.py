"""The box of trust grows after good steps that it stopped, and shrinks where nothing was
learned."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from hybrid_opt.polishing.point import LARGEST, TrustRegion

LEAST = 1e-3


def test_it_grows_after_two_steps_in_a_row_that_it_stopped() -> None:
    region = TrustRegion(0.5, LEAST)
    region.taken(0.5)
    assert region.radius == 0.5
    region.taken(0.5)
    assert region.radius == 1.0
    region.refused(learned=True)
    region.taken(1.0)
    assert region.radius == 1.0


def test_a_promised_gain_tells_at_once_whether_the_model_holds() -> None:
    region = TrustRegion(0.5, LEAST)
    region.taken(0.5, kept=0.5)
    assert region.radius == 0.5
    region.taken(0.5, kept=0.9)
    assert region.radius == 1.0
    region.taken(0.1, kept=2.0)
    assert region.radius == 1.0
    region.taken(0.1, kept=0.1)
    assert region.radius == 0.5


@given(st.lists(st.sampled_from(["lost", "refused", "barren", "taken"]), max_size=40))
def test_it_never_exceeds_its_largest_and_is_spent_at_last(events: list[str]) -> None:
    region = TrustRegion(1.0, LEAST)
    for event in events:
        match event:
            case "lost":
                region.lost()
            case "refused":
                region.refused(learned=False)
            case "barren":
                region.barren(region.radius / 2.0)
            case _:
                region.taken(region.radius)
        assert 0.0 < region.radius <= LARGEST
    for _ in range(20):
        region.lost()
    assert region.is_spent
