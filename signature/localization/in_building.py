"""Answers in the frame of a building: poses in the maps of joined sessions, moved into one frame."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from pc2grid.arrays import F64
from pc2grid.geometry import SE2
from signature.database.protocol import BuildingFrame
from signature.localization.answer import Answer, Moment, PoseInSpace
from signature.localization.hypotheses import Hypothesis

_APART = BuildingFrame(name="", T_building_session=SE2(), covariance=((0.0,) * 3,) * 3)
"""Of a session that is not joined: its poses stay as they are."""


def answer_in_building(answer: Answer, frames: Mapping[str, BuildingFrame]) -> Answer:
    """An answer with all poses in the frames of the buildings, where their sessions have one.

    frames : of sessions that were joined, by name (`SubmapDatabase.frames`). Covariances contain how exactly
    the session is known to lie in its building.
    """
    frame_of = [frames.get(name, _APART) for name in answer.sessions]
    hypotheses = tuple(
        _hypothesis(h, frame_of[h.session_index], answer.T_odom_base) for h in answer.hypotheses
    )
    stated = replace(
        answer,
        hypotheses=hypotheses,
        off_map=tuple(
            replace(
                away,
                hypothesis=_hypothesis(
                    away.hypothesis, frame_of[away.hypothesis.session_index], answer.T_odom_base
                ),
            )
            for away in answer.off_map
        ),
        history=tuple(_moment(moment, frames) for moment in answer.history),
        excluded=answer.excluded and _moment(answer.excluded, frames),
        frames=tuple(frame.name or None for frame in frame_of),
    )
    if answer.status != "located":
        return stated
    fit = hypotheses[0].fit
    return replace(
        stated,
        T_map_base=fit.T_map_query @ answer.T_odom_base,
        T_map_odom=fit.T_map_query,
        covariance=fit.covariance,
        in_space=answer.in_space and _in_space(answer.in_space, frame_of[hypotheses[0].session_index]),
    )


def covariance_in_building(covariance: F64, T_session_base: SE2, frame: BuildingFrame) -> F64:
    """The covariance (3, 3) of a pose in a session's map as one in its building: turned, and with that of the
    session's own place, whose heading moves the pose the more the farther it is from the session's origin."""
    T = frame.T_building_session
    there = frame.placed(T_session_base)
    turn = SE2(0.0, 0.0, there.yaw - T_session_base.yaw).matrix()
    J = np.eye(3)
    J[:2, 2] = T.y - there.y, there.x - T.x
    return np.asarray(turn @ covariance @ turn.T + J @ np.array(frame.covariance) @ J.T)


def _hypothesis(hypothesis: Hypothesis, frame: BuildingFrame, T_odom_base: SE2) -> Hypothesis:
    fit = hypothesis.fit
    T_map_base = fit.T_map_query @ T_odom_base
    T_building_query = frame.at(T_map_base.x, T_map_base.y) @ fit.T_map_query
    covariance = covariance_in_building(fit.covariance, T_map_base, frame)
    return replace(hypothesis, fit=replace(fit, T_map_query=T_building_query, covariance=covariance))


def _moment(moment: Moment, frames: Mapping[str, BuildingFrame]) -> Moment:
    frame = frames.get(moment.session or "", _APART)
    return replace(moment, pose=moment.pose and frame.placed(moment.pose))


def _in_space(pose: PoseInSpace, frame: BuildingFrame) -> PoseInSpace:
    T_map_base = SE2.from_matrix(pose.T_map_base)
    T = frame.at(T_map_base.x, T_map_base.y).lift()
    turn = np.kron(np.eye(2), T[:3, :3])
    covariance = turn @ pose.covariance @ turn.T
    planar = np.ix_((0, 1, 5), (0, 1, 5))
    nothing = np.zeros((3, 3))
    covariance[planar] += covariance_in_building(nothing, T_map_base, frame)
    return replace(pose, T_map_base=T @ pose.T_map_base, covariance=covariance)
