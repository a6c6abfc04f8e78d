"""The pose graph of a session while it grows: its local maps, the tracked steps between them, and loops."""

from __future__ import annotations

import math
from dataclasses import replace
from itertools import compress

import numpy as np

from pc2grid.arrays import F64, I64
from pc2grid.geometry import SE2
from pc2grid.mapping.building_axes import WallDirection
from pc2grid.mapping.local_maps import pose_at
from pc2grid.mapping.loop_parameters import LoopParameters
from pc2grid.mapping.pose_graph import Edge, Solution, optimise
from pc2grid.mapping.precision import position_sigmas


class SessionGraph:
    """The pose graph over the anchors of local maps.

    nodes : (N, 3) x, y, yaw of each anchor in the session, by the last optimisation. edges : tracked steps
    and loops, in the order in which they were found.
    """

    def __init__(self, parameters: LoopParameters) -> None:
        self._parameters = parameters
        self.nodes: F64 = np.empty((0, 3))
        self.edges: list[Edge] = []
        self._walls: list[WallDirection] = []  # of each local map
        # Of each tracked step, by its local maps: how exactly these determine it.
        self._step_information: dict[tuple[int, int], F64] = {}

    def __len__(self) -> int:
        return len(self.nodes)

    def add(self, pose: SE2, walls: WallDirection) -> None:
        """Add a local map at a pose."""
        self.nodes = np.vstack((self.nodes, (pose.x, pose.y, pose.yaw)))
        self._walls.append(walls)

    def extend(self, step: SE2, walls: WallDirection, shown: F64 | None) -> None:
        """Add the next local map, a tracked step from the last one.

        shown : information (3, 3) on the step by what both local maps show; None: tracking was lost.
        """
        newest = len(self)
        information = self._parameters.tracked_information(math.hypot(step.x, step.y), shown is None)
        self.edges.append(Edge(newest - 1, newest, step, information))
        if shown is not None:
            self._step_information[newest - 1, newest] = shown
        self.add(pose_at(self.nodes, newest - 1) @ step, walls)

    def relative(self, first: int, second: int) -> SE2:
        """T_first_second by the present poses."""
        return pose_at(self.nodes, first).inverse() @ pose_at(self.nodes, second)

    def solve(self) -> Solution:
        """Solve for the poses that agree best with all edges."""
        solution = optimise(self.nodes, self.edges, self._walls)
        self.nodes = solution.poses
        return solution

    def sigmas(self, solution: Solution, part: I64) -> F64:
        """Standard deviation (N,) in metres of the position of each local map within its part (N,).

        In the pose graph a tracked step counts as exact as it is wherever tracking works at all. How exact a
        step is by what its local maps show of each other is added here.
        """
        sigma_m = np.zeros(len(part))
        number = np.empty(len(part), np.int64)  # of each local map within its part
        for own in (np.flatnonzero(part == k) for k in range(int(part.max(initial=-1)) + 1)):
            number[own] = np.arange(len(own))
            within = [
                replace(
                    edge,
                    first=int(number[edge.first]),
                    second=int(number[edge.second]),
                    information=edge.information + self._step_information.get((edge.first, edge.second), 0.0),
                )
                for edge in compress(self.edges, solution.accepted)
                if part[edge.first] == part[edge.second] == part[own[0]]
            ]
            walls = [self._walls[local_map] for local_map in own]
            sigma_m[own] = position_sigmas(solution.poses[own], within, walls)[0]
        return sigma_m
