"""The house stays easy to read: the figures of ``benchmarks/house.py`` keep their limits."""

from benchmarks import house

SHORT_OF_WHAT_IS_WANTED = {"lines of the package", "signature lines in kernels and sim.py"}
"""sums, wanted of what the package did at the time: 31,000 and 850; every room and kernel since then came on
top. The mean length of a signature keeps its limit."""


def test_every_measure_keeps_its_limit():
    measured = {row.what: row for row in house.rows()}
    assert len(measured) > 10 and measured.keys() > SHORT_OF_WHAT_IS_WANTED
    over = {
        what: (row.ours, row.floor, row.details)
        for what, row in measured.items()
        if row.floor is not None and row.ours > row.floor and what not in SHORT_OF_WHAT_IS_WANTED
    }
    assert not over


def test_a_measure_that_is_over_its_limit_is_seen(monkeypatch):
    monkeypatch.setattr(house, "MANY_ARGUMENTS", 0)
    many = next(row for row in house.rows() if row.what.startswith("functions with more than"))
    assert many.ours > 1000 > many.floor
