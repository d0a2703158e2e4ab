"""``symbid prior``."""

from pathlib import Path
from typing import Annotated

import typer

from symbid_ros.cli.flags import BaseKind, Model
from symbid_ros.errors import PriorError


def prior(
    model: Model,
    out: Annotated[Path, typer.Option(help="prior.json to write.")],
    percent: Annotated[
        float | None, typer.Option(help="Each parameter uniform within ± this share, in %.")
    ] = None,
    absolute: Annotated[
        float | None, typer.Option(help="Each parameter uniform within ± this, in its SI unit.")
    ] = None,
    consistent: Annotated[
        float | None,
        typer.Option(help="Physically possible links, every moment within ± this share, in %."),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the draw.")] = 0,
    base: BaseKind = "auto",
) -> None:
    """Draw a prior around a model's inertias, as if they were known only roughly."""
    from symbid_ros.estimation.prior import Kind, draw_prior
    from symbid_ros.model.load import load_model
    from symbid_ros.model.parameters import ParameterSet

    amounts: dict[Kind, float | None] = {
        "percent": percent,
        "absolute": absolute,
        "consistent": consistent,
    }
    chosen = [(kind, amount) for kind, amount in amounts.items() if amount is not None]
    if len(chosen) != 1:
        raise PriorError("give exactly one of --percent, --absolute and --consistent", "E555")
    kind, amount = chosen[0]
    drawn = draw_prior(ParameterSet(load_model(model, base)), kind, amount, seed)
    drawn.write(out)
    typer.echo(f"{out}: {len(drawn.names)} parameters of {drawn.model}, {drawn.kind}, seed {seed}")
