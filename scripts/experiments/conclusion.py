"""The conclusion of the accuracy report, in words, from the numbers of its run."""

from typing import Any

Row = dict[str, Any]

TEXT = """\
The product stores positions in whole steps of 2^-24 block, moves by the mean of two velocities, clamps axis by axis \
and looks blocks up in dense cells: {ns:.0f} ns per step, {record}.

Numbers: the grid's rounding takes {grid_time:.2f} times the time of plain float64. Plain float64 is inside a block in \
{double_share:.1%} of the samples, up to {double_depth:.2g} deep, and differs between two compilers \
{double_corrections:.3g} times per player and minute. float32 ends {single_far:.2g} blocks off at 10^7. The price of \
the grid is that speeds are rounded to 2^-16: {minute:.1e} block after a minute of walking. A grid of 2^-16 takes \
{coarse_time:.2f} times as long as one of 2^-24, and at 128 Hz a minute ends {coarse_minute:.1e} off \
({middle_minute:.1e} with 2^-20, {fast_minute:.1e} with 2^-24).

Integrator: the apex of a jump is {apex:.2g} from the closed form with the mean, and {semi_apex:.2g} with the seed's \
semi-implicit integrator. The mean costs one more addition. At 60 Hz, where a tick is no binary fraction, the mean's \
apex is {sixty_apex:.1e} off.

Mover: going back along the velocity loses {back_lost:.0%} of the motion along a wall, the clamp {lost:.0%}. A sweep \
by time of impact loses {impact_lost:.0%} and takes {impact_time:.1f} times as long; it is inside a block in \
{impact_share:.1%} of the samples, the clamp in {share:.1%}.

Obstacles: merged slabs take {slab_time:.1f} times as long as cells. Without Numba the product takes {plain_us:.1f} us \
per step, and two machines differ {plain_corrections:g} times per player and minute."""


def conclusion(rows: list[Row]) -> str:
    """Returns the text: the choices that the product makes, and their costs."""

    def find(group: str, **wanted: object) -> Row:
        return next(row for row in rows if row["group"] == group and all(row[key] == wanted[key] for key in wanted))

    ours, variant = find("the product"), find("number format", format="grid 2^-24")
    single, double = find("number format", format="float32"), find("number format", format="float64")
    coarse, middle = (find("number format", format=f"grid 2^-{bits}", tick_rate=128) for bits in (16, 20))
    semi, sixty = find("integrator", integrator="semi", tick_rate=32), find("tick rate", tick_rate=60)
    back, impact = find("mover", mover="rewind"), find("mover", mover="impact")
    exact = not any(ours[key] for key in ("inside_depth", "error_1e6", "error_1e7", "corrections_per_minute"))
    return TEXT.format(
        ns=ours["ns"],
        record="never inside a block, the same bits at 10^7 blocks and on two machines" if exact else "and NOT EXACT",
        grid_time=variant["ns"] / double["ns"],
        double_share=double["inside_share"],
        double_depth=double["inside_depth"],
        double_corrections=double["corrections_per_minute"],
        single_far=single["error_1e7"],
        minute=ours["minute_error"],
        middle_minute=middle["minute_error"],
        coarse_minute=coarse["minute_error"],
        fast_minute=find("tick rate", tick_rate=128)["minute_error"],
        apex=abs(ours["apex_error"]),
        semi_apex=abs(semi["apex_error"]),
        share=ours["inside_share"],
        impact_share=impact["inside_share"],
        impact_lost=max(impact["tangential_lost"], 0.0),
        coarse_time=find("number format", format="grid 2^-16")["ns"] / variant["ns"],
        plain_corrections=find("executor", executor="plain")["corrections_per_minute"],
        sixty_apex=abs(sixty["apex_error"]),
        back_lost=back["tangential_lost"],
        lost=max(ours["tangential_lost"], 0.0),
        impact_time=impact["ns"] / variant["ns"],
        slab_time=find("obstacles")["ns"] / variant["ns"],
        plain_us=find("executor", executor="plain")["ns"] / 1e3,
    )
