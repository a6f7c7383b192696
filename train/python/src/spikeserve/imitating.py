"""`imitate`: from a Gymnasium environment and an expert to a served policy."""

from __future__ import annotations

import pathlib
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from spikeserve.imitation.options import ImitationOptions
    from spikeserve.imitation.report import ImitationResult


def imitate(
    env_id: str,
    expert: str | Callable[..., Any],
    out: str | pathlib.Path,
    *,
    options: ImitationOptions | None = None,
    wrappers: Sequence[Callable[[Any], Any]] = (),
    spiketrain: str | None = None,
    overwrite: bool = False,
) -> ImitationResult:
    """Trains a policy that imitates `expert` in a Gymnasium environment, and evaluates it.

    `expert` is a callable of (observation) or (environment, observation), its name
    `module:function`, a policy of Stable-Baselines3 (`PPO:file.zip`), or a dataset of Minari (an id
    or a folder), which cannot label the policy's own states. Everything is written below `out`:
    data, stages, policies for `spikeserve --policies`, report.md and metadata.json. A call with
    equal arguments continues an interrupted run, and equal arguments give an equal policy. A run
    with other arguments in the same folder is refused; `overwrite` deletes it and begins anew. A
    run whose expert or wrapper has no name of its own, such as a lambda, cannot be continued.

    Needs the extra `spikeserve-train[imitation]` and the program `spiketrain`: the argument,
    $SPIKETRAIN, or on PATH. ValueError for an environment or expert that cannot be used, before
    anything is recorded.
    """
    from spikeserve.imitation import pipeline  # its dependencies are optional

    return pipeline.imitate(
        env_id,
        expert,
        out,
        options=options,
        wrappers=wrappers,
        spiketrain=spiketrain,
        overwrite=overwrite,
    )
