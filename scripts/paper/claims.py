"""The claims of the paper, one by one: its figure, ours, and the verdict that follows from the numbers."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

from agents.knn.similarity import MEASURES
from scripts.paper.recognition import POINTS, VECTORS, VOTE
from scripts.paper.results import Results, against_cosine
from scripts.paper.sections import AGAIN, EXPLORER, TABLE_1, TABLE_2
from scripts.paper.timing import NEAR

USEFUL = 0.5
"""Share of places found, of cycles closed, or recall, from which a claim counts as useful."""
WHOLE = 0.99
"""Coverage from which a building has been seen, as the environment has it."""


class Claim(NamedTuple):
    """A line of the table of claims."""

    claim: str
    paper: str
    ours: str
    verdict: str


def confirmed(holds: bool) -> str:
    """Return a plain verdict."""
    return "confirmed" if holds else "not confirmed"


def _table_1(results: Results) -> Claim:
    fits = all(abs(results.golden[name] - value) <= 5e-4 for name, value in TABLE_1.items())
    return Claim(
        "The distances at the start (Table 1)",
        ", ".join(f"{value:g}" for value in TABLE_1.values()),
        "one pair of vectors of 7 whole numbers gives all seven" if fits else "our measures give others",
        confirmed(fits),
    )


def _least_error(results: Results) -> Claim:
    areas = results.areas(VECTORS[0], AGAIN)
    order = " > ".join(f"{name} {entry['area']:.2f}" for name, entry in areas.items())
    signs = {name: against_cosine(entry) for name, entry in areas.items() if name != "cosine"}
    better = [name for name, sign in signs.items() if sign == "+"]
    best = "confirmed, but not by Table 1" if set(signs.values()) == {"-"} else "undecided"
    return Claim(
        "Cosine has the least error (Table 1)",
        "0.002, the least of the seven",
        f"the table compares numbers of different units; by the area under precision over recall {order}; "
        f"surely better than cosine: {', '.join(better) or 'none'}",
        "not confirmed" if better else best,
    )


def _times(results: Results) -> Claim:
    rank, order = results.order_of_times()
    ours = [1000 * results.times[name]["pair"][1] for name in order]
    return Claim(
        "The time of a comparison, and the order of the measures (Table 2)",
        f"0.36 to 0.66 ms; {' < '.join(sorted(TABLE_2, key=TABLE_2.__getitem__))}",
        f"{ours[0]:.3f} to {ours[-1]:.2f} ms; {' < '.join(order)}; rank correlation with the paper's {rank:+.2f}",
        f"order: {confirmed(rank > 0.8)}",
    )


def _similarity_alone(results: Results) -> Claim:
    off = results.lap_errors["points"]
    near = sum(error <= NEAR for error in off.values())
    share = {name: results.recognised(AGAIN, name, POINTS)["share_right"] for name in MEASURES}
    return Claim(
        "Similarity alone misses the place (Fig. 4)",
        "12 pixels off the start",
        f"at the start {near} of {len(off)} measures find it, cosine is {off['cosine']:.1f} m off; on a whole second "
        f"lap cosine finds {share['cosine']:.0%} of the places, the best measure {max(share.values()):.0%}",
        confirmed(max(share.values()) < USEFUL),
    )


def _indicators(results: Results) -> Claim:
    off = results.lap_errors["vote"]["cosine"]
    points, voted = (results.recognised(AGAIN, "cosine", name)["share_right"] for name in (POINTS, VOTE))
    return Claim(
        "With indicators, groups and KNN it is found (Fig. 5)",
        "at the start",
        f"at the start cosine is {off:.1f} m off; on a second lap it finds {voted:.0%} of the places, {points:.0%} "
        "without",
        f"better: {confirmed(voted > points)}; found: {confirmed(voted > USEFUL)}",
    )


def _quicker(results: Results) -> Claim:
    points, direction, groups = map(results.search, ("points", "direction", "groups"))
    return Claim(
        "Comparing groups is quicker than comparing points",
        "stated, not measured",
        f"after {results.growth['path'][-1] / 1000:.0f} km, tables of the same direction: "
        f"{points.compared / direction.compared:.0f} times fewer comparisons, "
        f"{points.seconds / direction.seconds:.1f} times as quick; groups' centres first: "
        f"{points.compared / groups.compared:.0f} times fewer, {points.seconds / groups.seconds:.1f} times as quick",
        f"by direction: {confirmed(direction.seconds < points.seconds)}; by centres, in comparisons: "
        f"{confirmed(groups.compared < points.compared)}, in time: {confirmed(groups.seconds < points.seconds)}",
    )


def _centres(results: Results) -> Claim:
    direction, groups = map(results.search, ("direction", "groups"))
    return Claim(
        "The groups' centres make it more accurate",
        "stated, not measured",
        f"of known places {groups.found:.0%} are found by way of the centres, {direction.found:.0%} without them",
        confirmed(groups.found > direction.found),
    )


def _threshold(results: Results) -> Claim:
    f1 = max(results.recognised(EXPLORER, name, VOTE)["f1"] for name in MEASURES)
    sure = max(results.recognised(AGAIN, name, VOTE)["recall_99"] for name in MEASURES)
    return Claim(
        "A threshold tells places that have been visited (Step 5)",
        "no value given",
        f"best F1 of any measure as explored {f1:.2f}; on a second lap at most {sure:.0%} recall at 99 % precision",
        confirmed(sure > USEFUL),
    )


def _open_areas(results: Results) -> Claim:
    said, works = [], []
    for name, run in results.finished.items():
        left = run["area_states"].count("open")
        said.append(f"`{name}` lists {run['areas']}, leaves {left} open, sees {run['coverage']:.0%}")
        if not left and run["coverage"] >= WHOLE:
            works.append(f"`{name}`")
    return Claim(
        "Six open areas, each visited or struck off, then a stop (Fig. 6)",
        "6, none left open",
        "; ".join(said),
        f"the list works in: {', '.join(works) or 'neither'}; "
        f"six: {confirmed(any(run['areas'] == 6 for run in results.finished.values()))}",
    )


def _memory_points(results: Results) -> Claim:
    run = results.finished["extended"]
    return Claim(
        "Groups as memory points lead the robot back",
        "stated, not measured",
        f"`extended` retraces its rows: {run['path_length_m']:,.0f} m, {run['tours']:.2f} times the shortest closed "
        f"tour of all corridors, for {run['coverage']:.0%} of the building",
        confirmed(run["coverage"] >= WHOLE),
    )


def _limitation(results: Results) -> Claim:
    clean, poor = (results.noisy("paper", scale) for scale in (min(results.scope.noise_scales), 1.0))
    extended = results.noisy("extended", 1.0)
    return Claim(
        "Limitation: errors of rotation and shift are not taken into account",
        "stated, not measured",
        f"`paper` closes {clean['cycles_share']:.0%} of the cycles without noise ({clean['false_claims']:.1f} false "
        f"claims a run), {poor['cycles_share']:.0%} with `poor` ({poor['false_claims']:.1f}); `extended` with `poor` "
        f"{extended['cycles_share']:.0%} ({extended['false_claims']:.1f})",
        "can't be told: it fails without noise too"
        if clean["cycles_share"] < USEFUL
        else confirmed(poor["cycles_share"] < USEFUL * clean["cycles_share"]),
    )


def _not_tested(_: Results) -> Claim:
    return Claim(
        "Times in MATLAB, and distances in pixels", "seconds, pixels", "no code, machine or scale", "can't be tested"
    )


CLAIMS: tuple[Callable[[Results], Claim], ...] = (
    _table_1,
    _least_error,
    _times,
    _similarity_alone,
    _indicators,
    _quicker,
    _centres,
    _threshold,
    _open_areas,
    _memory_points,
    _limitation,
    _not_tested,
)


def claims(results: Results) -> list[Claim]:
    """Return all claims with their verdicts."""
    return [claim(results) for claim in CLAIMS]
