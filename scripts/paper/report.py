"""The report in Markdown: the claims with their verdicts, and what they rest on, section by section."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from agents.knn.config import calibrated_thresholds
from agents.knn.similarity import MEASURES
from scripts.paper.claims import claims
from scripts.paper.recognition import POINTS, SAME_DIRECTION, VECTORS, VOTE
from scripts.paper.results import Results, against_cosine
from scripts.paper.sections import AGAIN, AGENTS, EXPLORER, TABLE_1, TABLE_2, variations

WIDTH = 120
"""Characters of a line."""
DIRECTIONS = ("north", "east", "south", "west")
MARKS = (1000, 2000, 5000, 10_000)
"""Metres driven, at which the cost of a search is told."""


def report_text(results: Results, pictures: str = "") -> str:
    """Return the report in Markdown.

    Parameters
    ----------
    results : Results
    pictures : str
        What the names of the figures begin with: their folder, if it is another.
    """
    sections = (
        _opening(results),
        _claims(results),
        _table_1(results),
        _table_2(results),
        _growth(results),
        _figures(results),
        _ambiguities(results),
        _noise(results),
        _best_measure(results),
        _presets(results),
        _reproduce(results),
    )
    text = "\n\n".join(block for section in sections for block in section) + "\n"
    return text.replace("](", f"]({pictures}")


def paragraph(text: str) -> str:
    """Return a text as one paragraph in lines of `WIDTH`."""
    return textwrap.fill(" ".join(text.split()), WIDTH, break_long_words=False, break_on_hyphens=False)


def table(header: str, rows: Iterable[Iterable[Any]], *, numbers: bool = True) -> str:
    """Return a table in Markdown, its header with bars between the columns; all but the first may be numbers."""
    rule = "|---" + ("|---:" if numbers else "|---") * header.count("|") + "|"
    return "\n".join([f"| {header} |", rule, *(f"| {' | '.join(map(str, row))} |" for row in rows)])


def picture(name: str, caption: str) -> str:
    """Return a figure with its caption."""
    return f"![{caption}]({name}.png)\n\n*{caption}*"


def number(value: float | None, digits: int = 2) -> str:
    """Return a number with that many decimals, or a dash where there is none."""
    return "-" if value is None or math.isnan(value) else f"{value:,.{digits}f}"


def microseconds(quartiles: Sequence[float] | None) -> str:
    """Return a median and the quartiles around it, in microseconds, or a dash where there is none."""
    if quartiles is None:
        return "-"
    low, median, high = (1e6 * value for value in quartiles)
    digits = 3 if median < 1 else 1 if median < 100 else 0
    return f"{median:,.{digits}f} ({low:,.{digits}f} to {high:,.{digits}f})"


def interval(entry: Mapping[str, Any], name: str, digits: int = 2) -> str:
    """Return a mean with its interval in brackets, if it has one."""
    mean, low, high = (number(entry[key], digits) for key in (name, f"{name}_low", f"{name}_high"))
    return mean if low == "-" else f"{mean} [{low}, {high}]"


def listed(values: Iterable[float]) -> str:
    """Return numbers with commas between them."""
    return ", ".join(f"{value:g}" for value in values)


def _opening(results: Results) -> list[str]:
    return [
        "# The paper, reproduced and put to the test",
        paragraph("""
            A. R. Abdulnabi and M. F. Esmail, *Automatic mapping and localization in large-scale cyclic using K-nearest
            neighbours* (2022): a robot with a laser, a distance meter and a compass explores MIT's Killian Court. What
            it sees is kept as rows of properties in tables (groups), one for each time that it took to a compass
            direction. When it takes to a direction again, the K nearest rows among the earlier tables of that direction
            vote whether the place has been visited. The paper leaves much unsaid and gives no data: this is our reading
            of it, run in simulation, and a verdict is a verdict on that reading."""),
        paragraph(f"""
            Settings: **{results.scope.name}**. Two explorers: `paper`, the method as we read it, and `extended`, which
            also uses position and matches scans. Noise: `ideal` has no errors, as in the paper; `calibrated`, `typical`
            and `poor` are the presets of the environment. A *row* is what was sensed at one place, a metre after the
            one before. A row *returns* to an earlier one if that is within 3 m and in sight, at least 20 m of driving
            ago, and the robot was 10 m away in between."""),
    ]


def _claims(results: Results) -> list[str]:
    rows = [(*claim[:3], f"**{claim.verdict}**") for claim in claims(results)]
    return ["## Claims and verdicts", table("claim | the paper | ours | verdict", rows, numbers=False)]


def _table_1(results: Results) -> list[str]:
    tested, start = results.recognition, results.recognition["start"]
    rows = {"the paper": TABLE_1, "the pair": results.golden}
    if start is None:
        ours = "**Our own return.** The run of `extended` did not come back to its start: there is no table of our own."
    else:
        rows |= {"our return, as seen": start["ahead"], "our return, looking back": start["back"]}
        query, ahead, back = (
            f"({listed(start[name]).replace(',', '')})" for name in ("query", "start_ahead", "start_back")
        )
        ours = f"""
            **Our own return.** The run of `extended` comes back to its start after {start["query_path_m"]:,.0f} m,
            {start["off_m"]:.1f} m off the row there, driving {DIRECTIONS[start["query_direction"]]}; it had begun
            driving {DIRECTIONS[start["start_direction"]]}. What it sees, {query} half metres, is compared with what
            it saw then, {ahead}, and with that looking back, {back}."""
    variation = results.recognised(AGAIN, "variation", SAME_DIRECTION)
    return [
        "## 1. Table 1, three ways",
        paragraph("""
            **The paper's numbers.** The properties of a place are never defined, but Table 1 pins them down: Jaccard's
            3/7 and Euclid's root of 6 want seven whole numbers of which three differ, by 2, 1 and 1. The vectors
            (7 7 7 7 7 7 27) and (8 8 7 7 7 7 25) give all seven entries. So our definitions are the paper's, and the
            table is of a single comparison."""),
        table(
            f" | {' | '.join(MEASURES)}",
            ((what, *(number(values.get(name), 3) for name in MEASURES)) for what, values in rows.items()),
        ),
        paragraph(ours),
        paragraph("""
            **What the table can't show.** A distance of 0.002 is not smaller than one of 101.952: they have different
            units. What a measure is worth is what it decides over many places. Every row asks for the earlier row at
            the least distance, among all rows of at least 20 m ago (*points*), among those in other groups of the same
            direction (*direction*: the paper's indicators), or by the explorer's *vote* of 4. *Found* is the share of
            the rows that return somewhere whose answer is right; *area* is that under the curve of precision (of the
            answers below a threshold) over recall (of all rows that return). The vectors have 7 sectors, but
            all beams in the columns of these."""),
        paragraph(f"""
            *Rows {EXPLORER}*: {tested["rows"][EXPLORER]:,} rows of the run of `extended`, ideal sensors.
            {tested["revisits"][EXPLORER]} return somewhere, but only {tested["same_direction"]} in the direction of
            then, and the rule of the same direction can't find the others. *Rows {AGAIN}*: that way is driven a second
            time, in the same directions, a random part of a metre on; {tested["revisits"][AGAIN]:,} of
            {tested["rows"][AGAIN]:,} rows return. It is the best case for the paper."""),
        f"### Rows {EXPLORER}",
        _recognised(results, EXPLORER),
        f"### Rows {AGAIN}",
        _recognised(results, AGAIN),
        picture(
            "recognition",
            "Precision over recall of every measure; solid: same direction, dotted: all points (scales differ)",
        ),
        paragraph(f"""
            Variation adds the variances of both vectors, so it does not compare them at all, and equal places are not
            near: it finds {variation["share_right"]:.1%}. `recognition.csv` has all vectors with all candidates,
            best F1, recalls and the areas over all pairs of rows; `curves.csv` has the curves."""),
    ]


def _recognised(results: Results, rows: str) -> str:
    """Return what each measure recognises of the building's rows."""
    columns = [(POINTS, VECTORS[0]), (SAME_DIRECTION, VECTORS[0]), (VOTE, VECTORS[0]), (SAME_DIRECTION, VECTORS[1])]
    entries = {name: [results.recognised(rows, name, *column) for column in columns] for name in MEASURES}
    return table(
        "measure | found: points | direction | vote | beams, direction"
        " | area: points | direction | vote | beams, direction",
        (
            (name, *(f"{one['share_right']:.1%}" for one in several), *(number(one["area"], 3) for one in several))
            for name, several in entries.items()
        ),
    )


def _table_2(results: Results) -> list[str]:
    rank, order = results.order_of_times()
    by_row = sorted(TABLE_2, key=lambda name: results.times[name]["row"][1])
    slowest = max(entry["rows"][1] for entry in results.times.values())
    known = {name: entry for name, entry in results.times.items() if entry["sklearn"]}
    beaten = [name for name, entry in known.items() if entry["rows"][1] > entry["sklearn"][1]]
    sklearn = (
        f"it is quicker for {', '.join(beaten)}" if beaten else "each measure that it knows is at least as quick here"
    )
    return [
        "## 2. Table 2: the time of a comparison",
        paragraph("""
            Microseconds: median, and quartiles in brackets. *One pair*: one call for two vectors of 7 numbers, as of a
            program that goes from row to row. *10,000 rows*: a query is compared with as many stored rows at once, a
            run of 10 km, as the explorer does it; *one of many* is a row's share of that."""),
        table(
            "measure | the paper | one pair | one of many | 10,000 rows | scikit-learn, 10,000 rows",
            (
                (
                    name,
                    number(1e6 * TABLE_2[name] if name in TABLE_2 else None, 0),
                    *(microseconds(entry[what]) for what in ("pair", "row", "rows", "sklearn")),
                )
                for name, entry in results.times.items()
            ),
        ),
        "\n".join(
            (
                f"- Order of the paper: {' < '.join(sorted(TABLE_2, key=TABLE_2.__getitem__))}.",
                f"- Ours, one pair: {' < '.join(order)}; rank correlation with the paper's {rank:+.2f}.",
                f"- Ours, one of many: {' < '.join(by_row)}.",
            )
        ),
        paragraph(f"""
            One pair's time is mostly that of the call and its checks, and so, one may suspect, is the paper's: its
            measures differ by less than a factor of 2. 10,000 rows take {1000 * slowest:.2f} ms at
            most{", so time need not decide on the measure" if slowest < 1e-3 else ""}. scikit-learn's brute-force
            neighbours, on one thread and fitted before: {sklearn if known else "not installed, so not measured"}."""),
    ]


def _growth(results: Results) -> list[str]:
    growth, path = results.growth, np.array(results.growth["path"])
    ways = {"points": "all points", "direction": "same direction", "groups": "groups first"}
    rows = []
    for mark in MARKS:
        near = np.abs(path - mark) < 250
        if near.any():
            compared = [f"{np.array(growth[way])[near].mean():,.0f}" for way in ways]
            seconds = [f"{1e6 * np.median(np.array(growth[f'{way}_s'])[near]):,.0f}" for way in ways]
            rows.append((f"{mark / 1000:g} km", *compared, *seconds))
    direction, groups = results.search("direction").found, results.search("groups").found
    return [
        "## 3. Groups against points",
        paragraph(f"""
            The building's run, {results.scope.laps} laps of the same way, each with rows, scans and noise
            (`calibrated`) of its own. A query is one row of 7 sectors; the measure is cosine. *All points*: every row
            before. *Same direction*: the earlier tables of its direction. *Groups first*: the centres of these tables,
            then the rows of the four nearest. Comparisons are of rows and centres; times are medians."""),
        table(
            "driven | comparisons: all points | same direction | groups first"
            " | microseconds: all points | same direction | groups first",
            rows,
        ),
        picture("growth", "Comparisons and time of a query as the run grows"),
        paragraph(
            f"""
            From the second lap on, where every place is a known one, the tables of the direction give a row of the
            right place for {direction:.0%} of the queries, groups first for {groups:.0%}."""
            + (
                """ The mean of a corridor's rows is not like the rows at its ends, so a group's centre is a poor guide
                to them: what it saves in comparisons it pays for in places not found."""
                if groups < direction
                else ""
            )
        ),
    ]


def _figures(results: Results) -> list[str]:
    runs = []
    for name, run in results.finished.items():
        states = run["area_states"]
        counts = ", ".join(f"{states.count(state)} {state}" for state in sorted(set(states)))
        runs.append(
            f"- `{name}`: {run['areas']} open areas ({counts or 'none'}); {run['cycles_closed']} of "
            f"{run['cycles_total']} cycles closed, {run['false_claims']} false claims, {run['coverage']:.0%} seen, "
            f"{run['path_length_m']:,.0f} m; ended by: {run['ending']}."
        )
    return [
        "## 4. The paper's figures",
        picture("figure_1_building", "Figure 1: the building"),
        picture("figure_2_algorithm", "Figure 2: the algorithm, by the steps that the explorer's code names"),
        picture("figure_3_start", "Figure 3: the start, and what the laser sees there"),
        paragraph("""
            **Figures 4 and 5.** The robot has driven its way once, and is again a metre after its start, driving in the
            same direction. Which of the rows of the first lap is at the least distance?"""),
        picture("figure_4_similarity_alone", "Figure 4: similarity alone, all points of the first lap compared"),
        picture("figure_5_indicators_and_vote", "Figure 5: tables of the same direction, and the vote of 4"),
        "Metres from the robot to what is found, by measure:",
        table(
            f" | {' | '.join(MEASURES)}",
            ((how, *(number(off[name], 1) for name in MEASURES)) for how, off in results.lap_errors.items()),
        ),
        paragraph(f"""
            One place proves little: *found* in section 1 is the same test on
            {results.recognition["revisits"][AGAIN]:,} places."""),
        paragraph("""
            **Figure 6.** The finished run. Discs are the open areas' list, numbered in the order in which they were
            left behind: black ones were visited, white ones struck off, having been seen into from elsewhere, amber
            ones are left open."""),
        picture("figure_6_extended", "Figure 6: the finished run of the preset `extended`"),
        picture("figure_6_paper", "Figure 6 again: where the preset `paper` stops"),
        "\n".join(runs),
    ]


def _ambiguities(results: Results) -> list[str]:
    scope = results.scope
    by_key = {(entry["reading"], entry["value"], entry["map"]): entry for entry in results.varied}
    readings = [(reading, value) for reading, values in variations(scope).items() for value in values]
    returns = {key: np.mean([by_key[(*key, plan)]["return"] for plan in scope.varied_maps]) for key in readings}
    best, worst = max(returns, key=returns.__getitem__), min(returns, key=returns.__getitem__)
    reaches = {
        entry["reach_m"]: {
            "paper": by_key["reach of the laser, m", f"{entry['reach_m']:g}", scope.building]["areas"],
            "extended": entry["areas"],
        }
        for entry in results.reaches
    }
    six = [f"`{name}` at {reach:g} m" for reach, areas in reaches.items() for name in areas if areas[name] == 6]
    return [
        "## 5. What the paper leaves open",
        paragraph("""
            The preset `paper`, ideal sensors, one reading varied at a time. A cell is: cycles closed, precision,
            recall, metres driven, return (100 is a perfect run; a false claim costs 5). A dash: nothing to judge. Rows
            with the preset's own value, such as K: 4, are one and the same run."""),
        table(
            f"reading | {' | '.join(scope.varied_maps)}",
            (
                (f"{reading}: {value}", *(_cell(by_key[reading, value, plan]) for plan in scope.varied_maps))
                for reading, value in readings
            ),
        ),
        paragraph(f"""
            Mean return over the plans: best {returns[best]:.0f} ({": ".join(best)}), worst {returns[worst]:.0f}
            ({": ".join(worst)})."""),
        f"Open areas that are listed on {scope.building}, by the laser's reach:",
        table(
            f" | {' | '.join(f'{reach:g} m' for reach in reaches)}",
            ((f"`{name}`", *(f"{areas[name]:.0f}" for areas in reaches.values())) for name in ("paper", "extended")),
        ),
        paragraph(f"""
            The list holds the paper's six for: {", ".join(six) or "none of these"}. It numbers every opening that is
            left behind; `paper` goes only to those with no wall within the reach, and may stop with others open."""),
    ]


def _cell(entry: Mapping[str, Any]) -> str:
    """Return a run in short: cycles, precision, recall, path and return."""
    return (
        f"{entry['cycles']:.0f}/{entry['cycles_total']:.0f}, {number(entry['precision'])}, {number(entry['recall'])}, "
        f"{entry['path_m']:,.0f}, {entry['return']:.0f}"
    )


def _noise(results: Results) -> list[str]:
    scope = results.scope
    clean, worst = min(scope.noise_scales), max(scope.noise_scales)
    position, both = (results.noisy(agent, clean) for agent in ("extended, position only", "extended"))
    as_good = position["recall"] >= both["recall"] and position["false_claims"] <= both["false_claims"]
    return [
        "## 6. The limitation, and the future work",
        paragraph(f"""
            Errors of rotation (compass) and of shift (distance meter, laser), from none to those of `poor`, all scaled
            by one factor, on {", ".join(scope.noise_maps)}. Means over the runs, and Student's 95 % intervals in
            brackets; precision and recall are of all runs together. *Off*: rms error of dead reckoning and of the
            explorer's track. *KNN only* and *position only* are `extended` with the one or the other in place of
            both."""),
        table(
            "agent | noise | runs | share of cycles | false claims | precision | recall | dead reckoning off, m"
            " | track off, m",
            (
                (
                    entry["agent"],
                    entry["noise"],
                    entry["runs"],
                    interval(entry, "cycles_share"),
                    interval(entry, "false_claims"),
                    *(number(entry[name]) for name in ("precision", "recall")),
                    *(number(entry[name], 1) for name in ("dead_reckoning_rms_m", "track_rms_m")),
                )
                for entry in results.noise
            ),
        ),
        picture("noise", "Cycles, false claims and recall over the noise"),
        "Where it breaks, as a share of the noise of `poor`:",
        table(
            "agent | a false claim a run or more from | fewer than half of the cycles from",
            ((agent, *_breaks(results, agent)) for agent in AGENTS),
        ),
        paragraph(f"""
            Without noise, dead reckoning alone, which claims by position and uses the laser for driving only,
            recognises {position["recall"]:.0%} of the revisits with {position["false_claims"]:.1f} false claims a run
            (with KNN and scans {both["recall"]:.0%} and {both["false_claims"]:.1f}):
            {"**in the paper's world the laser is not needed to know a place**" if as_good else "the laser helps"}.
            False claims a run at {worst:g} x poor:
            {"; ".join(f"{agent} {results.noisy(agent, worst)['false_claims']:.1f}" for agent in AGENTS)}.
            Position drifts with the distance meter and the compass; looks do not drift, but repeat. So `extended` lets
            position say which places may be meant, the vote which of them look alike, and matched scans which of these
            it is."""),
    ]


def _breaks(results: Results, agent: str) -> list[str]:
    """Return the least noise at which an agent makes a false claim a run, and closes fewer than half of the cycles."""
    mine = {scale: results.noisy(agent, scale) for scale in sorted(results.scope.noise_scales)}
    claims = [scale for scale, entry in mine.items() if entry["false_claims"] >= 1]
    cycles = [scale for scale, entry in mine.items() if entry["cycles_share"] < 0.5]
    return [f"{found[0]:g}" if found else "never" for found in (claims, cycles)]


def _best_measure(results: Results) -> list[str]:
    cells = [(vectors, rows) for vectors in VECTORS for rows in (EXPLORER, AGAIN)]
    areas = {cell: results.areas(*cell) for cell in cells}
    said = []
    for (vectors, rows), entries in areas.items():
        better, worse = ([name for name in entries if against_cosine(entries[name]) == sign] for sign in "+-")
        best = next(iter(entries))
        said.append(
            f"- {vectors}, rows {rows}: best is {best} ({entries[best]['area']:.3f}); surely better than cosine: "
            f"{', '.join(better) or 'none'}; surely worse: {', '.join(worse) or 'none'}."
        )
    most = {cell: next(iter(entries.values()))["area"] for cell, entries in areas.items()}
    return [
        "## 7. Is cosine best?",
        paragraph(f"""
            All {len(results.scope.maps)} plans, `calibrated` sensors, {results.scope.seeds} run(s) of each; candidates
            of the same direction. The mean area under precision over recall, with its 95 % interval by a bootstrap over
            plans; + or - where the difference from cosine's, taken within each draw, is surely above or below 0.
            `measures.csv` has these differences, F1 and recalls."""),
        table(
            f"measure | {' | '.join(map(', '.join, cells))}",
            ((name, *(_area(entries[name]) for entries in areas.values())) for name in MEASURES),
        ),
        picture("measures", "Area under precision over recall of every measure, with 95 % intervals over plans"),
        "\n".join(said),
        paragraph(f"""
            What is compared matters beside how: of rows {AGAIN} the best area is {most[VECTORS[0], AGAIN]:.2f} with
            7 sectors and {most[VECTORS[1], AGAIN]:.2f} with all beams; of rows {EXPLORER} it is
            {most[VECTORS[0], EXPLORER]:.2f} and {most[VECTORS[1], EXPLORER]:.2f}, for an exploration seldom drives a
            corridor twice in one direction, and the rule looks nowhere else."""),
    ]


def _area(entry: Mapping[str, Any]) -> str:
    return f"{interval(entry, 'area', 3)} {against_cosine(entry)}"


def _presets(results: Results) -> list[str]:
    by_key = {(entry["map"], entry["noise"], entry["preset"]): entry for entry in results.presets}
    columns = "cycles | false claims | recall | seen | path, m | return"
    rows = []
    for plan, noise in dict.fromkeys((entry["map"], entry["noise"]) for entry in results.presets):
        pair = [by_key[plan, noise, preset] for preset in ("paper", "extended")]
        rows.append((f"{plan}, {noise}", pair[0]["runs"], *(cell for entry in pair for cell in _scores(entry))))
    return [
        "## The presets on all plans",
        paragraph(f"""
            First `paper`, with the calibrated threshold of its measure, cosine
            ({calibrated_thresholds()["cosine"]:.4f}), then `extended`; means over the runs."""),
        table(f"plan, noise | runs | `paper`: {columns} | `extended`: {columns}", rows),
    ]


def _scores(entry: Mapping[str, Any]) -> list[str]:
    return [
        f"{entry['cycles']:.1f} of {entry['cycles_total']:.0f}",
        number(entry["false_claims"], 1),
        number(entry["recall"]),
        f"{entry['coverage']:.0%}",
        number(entry["path_m"], 0),
        number(entry["return"], 0),
    ]


def _reproduce(results: Results) -> list[str]:
    scope, quick = results.scope, results.scope.name == "quick"
    versions = ", ".join(f"{name} {version}" for name, version in results.versions.items())
    return [
        "## How it was made",
        paragraph(f"""
            `python scripts/reproduce_paper.py{" --quick" * quick}` writes every number here. Seeds are 0, 1, 2 ... of
            each setting. Versions: {versions}. Scope `{scope.name}`: {scope.seeds} noisy run(s) of each plan; noise on
            {len(scope.noise_maps)} plans at {len(scope.noise_scales)} scales, {scope.noise_seeds} seed(s) each; K
            {listed(scope.neighbours)}; sectors {listed(scope.sectors)}; reach {listed(scope.reaches)} m; thresholds
            {listed(scope.thresholds)} and the calibrated one.
            {"The full scope has more seeds and settings." if quick else ""}
            Thresholds were calibrated on generated training plans alone (`scripts/calibrate_thresholds.py`), for the
            best F1 of the vote."""),
    ]
