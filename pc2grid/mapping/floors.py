"""The names and heights of the floors that a recording reaches."""

from __future__ import annotations

from collections.abc import Sequence

from pc2grid.model import Storey


def floor_names(storeys: Sequence[Storey], reached: Sequence[int]) -> list[str | None]:
    """The names of the floors that parts of a recording are on, by height: 0, 1, 2, the lowest is 0.

    storeys : of the recording. reached : number of the storey of each part. A ride in a lift shows no height:
    what lies behind the first one is "lift 1", or "lift 1, floor 0" and so on if stairs lead on from there.
    None for all, if the recording stays on one floor.

    >>> floor_names([Storey(group=0, height_m=0.0), Storey(group=0, height_m=-3.0)], [0, 1, 0])
    ['1', '0', '1']
    >>> floor_names([Storey(group=0, height_m=0.0), Storey(group=1, height_m=0.0)], [0, 1])
    ['0', 'lift 1']
    """
    if len(storeys) == 1:
        return [None] * len(reached)
    names = []
    for storey in (storeys[k] for k in reached):
        heights = [other.height_m for other in storeys if other.group == storey.group]
        rank = str(sum(height < storey.height_m for height in heights))
        if storey.group:
            rank = f"lift {storey.group}" + (f", floor {rank}" if len(heights) > 1 else "")
        names.append(rank)
    return [*names]


def floor_heights(storeys: Sequence[Storey], reached: Sequence[int]) -> list[float | None]:
    """The heights in metres of the floors that parts of a recording are on, above the lowest one.

    Parameters are those of `floor_names`. None where no stairs lead, and behind a lift.

    >>> floor_heights([Storey(group=0, height_m=0.0), Storey(group=0, height_m=-3.0)], [0, 1, 0])
    [3.0, 0.0, 3.0]
    >>> floor_heights([Storey(group=0, height_m=0.0), Storey(group=1, height_m=0.0)], [0, 1])
    [None, None]
    """
    known = [storey.height_m for storey in storeys if not storey.group]
    if len(known) == 1:
        return [None] * len(reached)
    here = [storeys[k] for k in reached]
    return [None if storey.group else storey.height_m - min(known) for storey in here]
