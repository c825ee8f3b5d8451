"""The table of evaluations."""

from __future__ import annotations

from scripts._tables import format_table, table_notes
from tests.helpers import evaluation, record


def cells(table: str) -> list[list[str]]:
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines()]


def test_table_leads_with_cycles_closed_and_false_claims() -> None:
    header, _, line = cells(format_table([evaluation(record(), record(**{"return": 8.0}))], markdown=True))
    assert header[5:9] == ["episodes", "cycles closed", "false claims", "return"]
    assert line[5:9] == ["2", "1.0 of 2", "3.0", "6.0 [-19.4, 31.4]"]


def test_table_has_a_dash_where_nothing_was_judged() -> None:
    silent = evaluation(record(false_claims=0, revisits=0, revisits_recognised=0))
    header, _, line = cells(format_table([silent], markdown=True))
    assert [line[header.index(column)] for column in ("precision", "recall")] == ["-", "-"]


def test_identical_episodes_have_no_interval_and_the_table_says_so() -> None:
    result = evaluation(record(), record(seed=1))
    assert "2 identical" in format_table([result])
    assert "[" not in format_table([result])
    assert "identical" in table_notes([result])[0]


def test_episodes_that_were_cut_short_are_marked() -> None:
    table = format_table([evaluation(record(), seeds=(0, 1)), evaluation(seeds=(0,))])
    assert "1 (cut short)" in table
    assert "0 (cut short)" in table


def test_table_names_the_action_type_and_warns_of_discrete() -> None:
    wheels, discrete = evaluation(record()), evaluation(record(), action_type="discrete")
    lines = format_table([wheels, discrete]).splitlines()
    assert [line.split()[3] for line in lines] == ["actions", "wheels", "discrete"]
    assert len(table_notes([wheels, discrete])) == len(table_notes([wheels])) + 1
