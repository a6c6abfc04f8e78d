"""The settings of the point-cloud half, read from a TOML file and from `section.key=value`, and written as
TOML.

Each number that a user may change has a name, unit, default and meaning. There is one section for each stage,
and a stage takes only its own section. Sections are frozen. An unknown key or a value out of range is an
error. `Config` holds the sections of this package; `signature.config.Config` adds those of the package above,
so the functions take any tree of `Section`s.

TOML has no null. In a dump, a setting that is null is a commented line if null is its default, else the text
"null". On the command line it is `section.key=null`.
"""

from __future__ import annotations

import difflib
import json
import os
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from typing_extensions import Self

from pc2grid.errors import ConfigError


class Section(BaseModel):
    """Base of all sections: frozen, no unknown keys, finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, validate_default=True)

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """Yield what differs from the defaults, so that a notebook shows one line and not a hundred
        settings."""
        for name, field in type(self).model_fields.items():
            value = getattr(self, name)
            if value != field.default:
                yield name, value


class ReadConfig(Section):
    """How a recording is read."""

    topic: str | None = Field(
        None, description="topic of the scans, or several, /a,/b, of one kind; null: the only one that fits"
    )
    odometry: str | None = Field(None, description='odometry topic; null: found in the log; "none": ignored')
    imu: str | None = Field(
        None, description='IMU topic; null: found where there is no odometry; "none": ignored'
    )
    base_frame: str | None = Field(
        None, description="null: base_link, base_footprint, or the sensor if no tf"
    )
    assume_identity: bool = Field(
        False, description="treat a sensor frame that tf does not connect as the base"
    )
    depth_stride: int = Field(
        2, ge=1, le=16, description="every n-th row and column of a depth image is used"
    )
    depth_unit_m: float | None = Field(
        None,
        gt=0,
        le=1,
        description="unit of depth images, m, such as 0.0002; null: 16UC1 in millimetres, 32FC1 in metres",
    )
    point_time: Literal["auto", "s", "ms", "us", "ns", "none"] = Field(
        "auto", description="unit of the per-point times of a cloud; none: ignore them"
    )
    max_range_m: float = Field(1000.0, gt=0, description="farther returns of any sensor are ignored")
    max_chunk_bytes: int = Field(256 << 20, gt=0, description="a chunk that expands to more is refused")
    max_record_bytes: int = Field(1 << 30, gt=0, description="a larger record of a log is refused")
    unit_m: float = Field(1.0, gt=0, le=1e4, description="unit of a cloud or mesh; 0.001: millimetres")
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = Field(
        "z", description="axis of a cloud or mesh that points up; -y: y points down, as in a camera"
    )
    floor_z: float | None = Field(
        None, description="height of a cloud's floor, m, after unit_m and up; null: found as a level plane"
    )
    max_points: int = Field(20_000_000, gt=0, description="a scan that claims more points is refused")


class RegistrationConfig(Section):
    """Scans -> poses."""

    icp: Literal["kiss-icp", "none"] = Field(
        default="kiss-icp",
        description="what brings a scan near; none: its predicted pose, as a control of what KISS-ICP does",
    )
    voxel_m: float | None = Field(
        default=None,
        gt=0,
        description="KISS-ICP voxel; null: a hundredth of its range, in the hand by the first ranges",
    )
    min_range_m: float = Field(default=0.3, ge=0, description="nearer returns are from the robot itself")
    max_range_m: float | None = Field(
        default=None, gt=0, description="of KISS-ICP; null: its own, 100 m; in the hand twice that of the map"
    )
    deskew: bool = Field(
        default=True, description="undo the motion within a scan where per-point times exist"
    )


class ProjectionConfig(Section):
    """Registered scans -> occupancy grid."""

    resolution_m: float = Field(default=0.05, gt=0.005, le=1.0, description="edge of a grid cell")
    band_min_m: float = Field(default=0.2, description="lower edge of the obstacle band above the floor")
    band_max_m: float = Field(default=1.8, description="upper edge of the obstacle band above the floor")
    max_range_m: float = Field(
        default=20.0, gt=0, description="returns farther than this do not draw the map"
    )
    points_voxel_m: float | None = Field(
        default=0.05,
        ge=0.01,
        le=1.0,
        description="of lidars and depth cameras the points in space are kept, too, one for each voxel of"
        " this edge; null: none",
    )
    max_cells: int = Field(default=100_000_000, gt=0, description="a map larger than this is refused")


Thinning = Literal["guo_hall", "zhang_suen"]


class PartitionConfig(Section):
    """Occupancy grid -> submaps (paper III-A).

    By default a submap is what is seen within 5 m from a point every metre along the free space. A robot that
    has driven a few metres has seen all of such a view, but only a part of a disc. `paper` is the method of
    the paper: one disc of 8 m around each junction of the free space.

    >>> PartitionConfig.paper().view, PartitionConfig.paper().radius_m
    ('disc', 8.0)
    """

    view: Literal["disc", "isovist"] = Field(
        "isovist",
        description="isovist: only what is seen from the centre; disc: all within the radius, as III-A",
    )
    radius_m: float = Field(5.0, gt=0, description="submap radius r; the paper's is 8 (Table II)")
    clearance_m: float = Field(
        0.3,
        ge=0,
        description="free space is eroded by this before thinning: keeps doors, drops gaps in furniture",
    )
    cluster_m: float = Field(1.0, gt=0, description="DBSCAN radius that merges junction pixels")
    thinning: Thinning = Field(
        "zhang_suen", description="zhang_suen keeps fewer side branches than guo_hall, so fewer junctions"
    )
    spacing_m: float | None = Field(
        1.0,
        gt=0,
        description="also a submap every so far along the skeleton; null: junctions only, as III-A",
    )

    @classmethod
    def paper(cls, radius_m: float = 8.0) -> Self:
        """Return discs around junctions, as in the paper (III-A; 8 m is r of Table II)."""
        return cls(view="disc", radius_m=radius_m, spacing_m=None)


class Config(Section):
    """The settings of a recording's way to a map with submaps.

    >>> config = Config()
    >>> config.partition.radius_m, config.projection.resolution_m
    (5.0, 0.05)
    >>> Config.paper().partition.radius_m
    8.0
    """

    read: ReadConfig = ReadConfig()
    registration: RegistrationConfig = RegistrationConfig()
    projection: ProjectionConfig = ProjectionConfig()
    partition: PartitionConfig = PartitionConfig()

    @classmethod
    def paper(cls) -> Self:
        """Return the defaults, but with the submaps of the paper."""
        return cls(partition=PartitionConfig.paper())


if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ENVIRONMENT = "PC2GRID_CONFIG"

T = TypeVar("T", bound=Section)


def load_settings(
    model: type[T],
    file: Path | None = None,
    assignments: Sequence[str] = (),
    environment: Mapping[str, str] = os.environ,
    *,
    preset: T | None = None,
) -> T:
    """Load the settings of a tree: `assignments` override `file`, which overrides `preset`.

    file : a TOML file; None: the one that the environment variable PC2GRID_CONFIG names, if any.
    assignments : "section.key=value" each, the value as in TOML; text needs no quotes.
    preset : the settings that nothing else sets; None: the defaults of `model`.

    Raises ConfigError naming the key and the closest known one.
    """
    named = environment.get(ENVIRONMENT)
    path = file or (Path(named) if named else None)
    tree = _read_toml(path) if path else {}
    settings = _validated(model, tree, preset, str(path) if path else "--set")
    if not assignments:
        return settings
    for assignment in assignments:
        _assign(tree, assignment)
    return _validated(model, tree, preset, "--set")


def dump_settings(settings: Section) -> str:
    """Return the whole tree as TOML with a comment for every key; reading it back gives the same settings."""
    lines = ["# Settings of pc2grid. Lines that start with '# key =' are at null: chosen by the program."]
    for name, field in type(settings).model_fields.items():
        section, usual = getattr(settings, name), field.default
        lines += ["", f"# {(type(section).__doc__ or '').strip().splitlines()[0]}", f"[{name}]"]
        for key, info in type(section).model_fields.items():
            value = getattr(section, key)
            lines.append(f"# {info.description}" if info.description else f"# ({key})")
            kept = value is None and getattr(usual, key) is None
            # TOML writes numbers, booleans, texts and lists of them as JSON does.
            text = json.dumps("null" if value is None else value, ensure_ascii=False).replace(
                "\x7f", "\\u007f"
            )
            lines.append(f"# {key} =" if kept else f"{key} = {text}")
    return "\n".join(lines) + "\n"


def _read_toml(path: Path) -> dict[str, Any]:
    try:
        tree = tomllib.loads(path.read_text(encoding="utf-8"))
        for section in tree.values():
            if isinstance(section, dict):
                section.update({key: None for key, value in section.items() if value == "null"})
        return tree
    except FileNotFoundError:
        raise ConfigError(
            f"{path}: no such file", hint="`pc2grid config dump` prints one to start from"
        ) from None
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: not TOML: {error}") from None


def _assign(tree: dict[str, Any], assignment: str) -> None:
    name, equals, text = assignment.partition("=")
    section, dot, key = name.strip().partition(".")
    if not equals or not dot or not key:
        raise ConfigError(
            f"--set {assignment}: expected section.key=value", hint="for example --set partition.radius_m=5"
        )
    try:
        value = tomllib.loads(f"value = {text}")["value"]
    except tomllib.TOMLDecodeError:
        value = None if text.strip() == "null" else text
    branch = tree.setdefault(section, {})
    if isinstance(branch, dict):
        branch[key] = value


def _validated(model: type[T], tree: dict[str, Any], preset: T | None, origin: str) -> T:
    try:
        return model.model_validate(tree if preset is None else _over(preset, tree))
    except ValidationError as error:
        first = error.errors()[0]
        key = ".".join(str(part) for part in first["loc"])
        if first["type"] == "extra_forbidden":
            if "." not in key and isinstance(first["input"], dict) and len(first["input"]) == 1:
                key = f"{key}.{next(iter(first['input']))}"
            closest = _closest(model, key)
            hint = f"did you mean {closest}?" if closest else "`pc2grid config dump` lists all settings"
            raise ConfigError(f"{origin}: unknown setting {key}", hint=hint) from None
        complaint = first["msg"][:1].lower() + first["msg"][1:]
        raise ConfigError(
            f"{origin}: {key}: {complaint}, found {first['input']!r:.60}",
            hint="`pc2grid config dump` explains every setting",
        ) from None


def _over(preset: Section, tree: dict[str, Any]) -> dict[str, Any]:
    """Return the tree with the values of `preset` where it has none."""
    full = preset.model_dump()
    for name, section in tree.items():
        both = isinstance(section, dict) and isinstance(full.get(name), dict)
        full[name] = full[name] | section if both else section
    return full


def _closest(model: type[Section], key: str) -> str | None:
    """Return the known setting whose name is nearest, or whose last part is the same in another section.

    For a section it is a section.
    """
    known = [] if "." in key else list(model.model_fields)
    for section, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, Section):
            known += [f"{section}.{name}" for name in field.annotation.model_fields]
    last = key.rpartition(".")[2]
    same = [name for name in known if name.rpartition(".")[2] == last]
    near = same or difflib.get_close_matches(key, known, n=1)
    return near[0] if near else None
