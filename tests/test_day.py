"""The rolling day of LIM-06: never less than 24 hours, by the hour."""

from hypothesis import given
from hypothesis import strategies as st

from firmware_sim.day import HOURS, STEPS_PER_HOUR, Day


def naive(given_at: list[tuple[int, int]], step: int) -> int:
    hour = step // STEPS_PER_HOUR
    return sum(amount for at, amount in given_at if hour - at // STEPS_PER_HOUR < 25)


def reborn(day: Day) -> Day:
    other = Day()
    other.restore(iter(day.save()))
    return other


@given(
    st.lists(
        st.tuples(
            st.integers(0, 1000) | st.integers(0, 13) | st.integers(280, 320), st.integers(0, 10**6), st.booleans()
        )
    )
)
def test_it_is_the_sum_of_the_running_hour_and_the_24_before(gaps: list[tuple[int, int, bool]]) -> None:
    day, given_at, step = Day(), [], 0
    for gap, amount, reset in gaps:
        step += gap
        day.add(amount, step)
        given_at.append((step, amount))
        if reset:
            day = reborn(day)
        assert day.total == naive(given_at, step)
        exact = sum(amount for at, amount in given_at if step - at < 288)
        assert day.total >= exact  # never too early


def test_an_amount_stays_24_hours_and_goes_within_25() -> None:
    for start in range(12):
        day = Day()
        day.add(7, start)
        for step in range(start + 1, 400):
            day.add(0, step)
            assert day.total == (7 if step < 300 else 0)


def test_a_long_gap_empties_it() -> None:
    for hours, left in ((24, 1000), (25, 0), (26, 0), (50, 0), (10**4, 0)):
        day = Day()
        day.add(1000, 5)
        day.add(3, 12 * hours)
        assert day.total == left + 3


def test_a_step_of_the_past_forgets_nothing() -> None:
    day = Day()
    day.add(5, 600)
    day.add(2, 12)
    assert day.total == 7
    day.add(0, 600 + 12 * 24 - 1)
    assert day.total == 7


def test_the_words_are_as_many_whatever_was_given() -> None:
    day = Day()
    assert len(day.save()) == HOURS + 1
    day.add(5, 5000)
    assert len(day.save()) == HOURS + 1
    assert reborn(day).save() == day.save()
