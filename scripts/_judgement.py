"""What commands print of the judge's report."""

from __future__ import annotations

import math

from agents.slam.closure_price import ClosurePrice
from cyclic_env.evaluation.judge import JudgeReport
from scripts._tables import format_rows


def report_text(report: JudgeReport, price: ClosurePrice | None = None) -> str:
    """Return the report, one thing a line, and a table of the verdicts by definition."""
    parts = [format_rows(report_rows(report)), "", verdict_table(report)]
    if price is not None:
        parts += ["", format_rows(price_rows(price))]
    return "\n".join(parts)


def report_rows(report: JudgeReport) -> dict[str, str]:
    """Return what the report says, each with its name."""
    ours, closure = report.verdicts[0], report.closure
    rows = {
        "reference": f"{report.poses:,} poses, {report.path_length_m:,.0f} m; {report.rows:,} of them are rows",
        "claims": f"{report.claims_given:,} given, {report.claims:,} judged, {closure.claim_spacing:g} m apart",
    }
    left_out = {"without a pose at their time": report.claims_unmatched, "repeated": report.claims_repeated}
    rows["claims"] += "".join(f"; {count:,} {what}" for what, count in left_out.items() if count)
    rows["false claims"] = f"{report.false_claims:,} of {report.claims:,}"
    rows["revisits recognised"] = f"{report.revisits_recognised} of {report.revisits} events"
    rows["row recall"] = f"{ours.row_recall:.3f}: {ours.right:,} of {ours.rows:,} rows that return"
    if report.cycles_total is None:
        rows["cycles closed"] = "not counted, and sight not checked: no map was given"
    else:
        rows["cycles closed"] = f"{report.cycles_closed} of {report.cycles_total}"
    if closure.wall_tolerance:
        rows["wall tolerance"] = f"{closure.wall_tolerance:.1f} m, as deep as the reference runs into the map's walls"
    if report.ate_m is not None:
        rows["ATE RMSE"] = f"{report.ate_m:.3f} m, {report.ate_aligned_m:.3f} m aligned"
        rows["relations"] = "the trajectory has none of their poses"
    if report.relations is not None:
        errors = report.relations
        rows["relations"] = (
            f"{errors.translation_m:.4f} +- {errors.translation_std_m:.4f} m, "
            f"{math.degrees(errors.rotation_rad):.2f} +- {math.degrees(errors.rotation_std_rad):.2f} degrees; "
            f"{errors.relations:,} {report.relations_are}"
        )
    return rows


def verdict_table(report: JudgeReport, layout: str = "simple") -> str:
    """Return a table with a line for each definition of a return."""
    import pandas as pd  # slow to import, and not needed before there is something to show

    table = pd.DataFrame(
        {
            "a claim is right": verdict.definition,
            "rows": f"{verdict.rows:,}",
            "right": f"{verdict.right:,}",
            "wrong": f"{verdict.wrong:,}",
            "precision": f"{verdict.precision:.3f}",
            "recall": f"{verdict.row_recall:.3f}",
            "recall at 100 %": f"{verdict.curve.recall_at_100_precision:.3f}",
            "F1 max": f"{verdict.curve.f1_max:.3f}",
            "extended precision": f"{verdict.curve.extended_precision:.3f}",
        }
        for verdict in report.verdicts
    )
    align = ["left", *["right"] * 8]
    return table.to_markdown(index=False, tablefmt=layout, colalign=align, disable_numparse=True)


def price_rows(price: ClosurePrice) -> dict[str, str]:
    """Return what the claims do to the map: ATE RMSE after alignment, metres."""
    rows = {
        "map error": f"{price.odometry_m:.2f} m by the odometry alone",
        "with right claims": f"{price.right_m:.2f} m; robust {price.right_robust_m:.2f} m",
        "with all claims": f"{price.all_m:.2f} m; robust {price.all_robust_m:.2f} m, which leaves out "
        f"{price.rejected_false} of {price.false} false and {price.rejected_right} of {price.right} right ones",
    }
    if price.each:
        plain = sorted(error - price.right_m for _, error, _ in price.each)
        robust = sorted(error - price.right_robust_m for _, _, error in price.each)
        middle = len(plain) // 2
        rows["one false claim"] = (
            f"{plain[middle]:+.2f} m at the median of {len(plain)}, {plain[-1]:+.2f} m at most; "
            f"robust {robust[middle]:+.2f} m, {robust[-1]:+.2f} m"
        )
    return rows
