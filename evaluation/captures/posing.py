"""Joint poses of several sweeps of one scene by COLMAP's incremental or global mapping (``unghost[capture]``)."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import nullcontext, suppress
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

from ...core.errors import InvalidArgument, MissingExtra
from ...core.io import read_json, write_json
from .colmap import quiet_pycolmap

Progress = Callable[[str, int, int], None]
EXTRACT_AT_ONCE, MATCH_AT_ONCE = 8, 500  # photos and pairs between two reports of progress
SMALLEST_PART = 3  # photos
MATCHING = ("exhaustive", "sequential")
OVERLAP = 10  # photos, of sequential matching
NEEDED = (  # of pycolmap 4.2
    *("extract_features", "match_image_pairs", "incremental_mapping", "ImportedPairingOptions", "CameraMode"),
    *("FeatureExtractionOptions", "FeatureMatchingOptions", "ImageReaderOptions", "IncrementalPipelineOptions"),
    *("TwoViewGeometryOptions", "Reconstruction", "Device"),
)
STATE, DATABASE, PARTS, GLOBAL = "state.json", "database.db", "parts", "global"


class NotJoinedError(InvalidArgument):
    """COLMAP posed photos, and no part has enough of each sweep: a smaller minimum share could do."""


@dataclass(frozen=True)
class PosingSettings:
    """How :func:`pose_jointly` works.

    Attributes:
        one_lens: all sweeps share one lens (same camera, same zoom and focus); else each has its own.
        longest_side: features are looked for in photos shrunk to this many pixels; smaller is faster.
        minimum_share: share of the photos of each sweep that must get a pose, or it is an error.
        seed: seed of COLMAP's random choices.
        threads: 0 for one per core; with 1, the same seed gives the same poses to the last bit, with more, nearly.
    """

    one_lens: bool = False
    longest_side: int = 1600
    minimum_share: float = 0.5
    seed: int = 0
    threads: int = 0

    def __post_init__(self) -> None:
        """Refuse what makes no sense."""
        if not 0 < self.minimum_share <= 1:
            raise InvalidArgument(f"PosingSettings: minimum_share must be in (0, 1], got {self.minimum_share}")
        if self.longest_side < 64:
            raise InvalidArgument(f"PosingSettings: longest_side must be >= 64 pixels, got {self.longest_side}")
        if self.seed < 0 or self.threads < 0:
            raise InvalidArgument(f"PosingSettings: seed and threads must be >= 0, got {self.seed} and {self.threads}")


@dataclass(frozen=True)
class Posing:
    """What :func:`pose_jointly` found.

    Attributes:
        posed: sweep -> names of its photos that have a pose.
        unposed: the other photos.
        reprojection_error: mean distance in pixels between a point's projection and the feature it stands for.
        points: how many points were triangulated.
        mapping: which mapping the poses are from, and why, in one line.
    """

    posed: Mapping[str, tuple[str, ...]]
    unposed: tuple[str, ...]
    reprojection_error: float
    points: int
    mapping: str = "incremental mapping"


def pose_jointly(
    folder: str | Path,
    sweeps: Mapping[str, Sequence[str]],
    *,
    out: str | Path,
    settings: PosingSettings | None = None,
    progress: Progress | None = None,
    work: Path | None = None,
) -> Posing:
    """Pose the photos of all sweeps in one world: SIFT features, every pair matched, incremental mapping, on the CPU.

    Lenses are OPENCV's with k1, k2, p1, p2; the focal length to begin with comes from EXIF where there is one. Where
    incremental mapping splits the photos into several parts, global mapping is tried too, if pycolmap has it; its
    lenses are SIMPLE_RADIAL, with k1 alone. Of the parts that COLMAP finds, the one with most photos of those that join
    all sweeps is kept; of two with equally many, the one of incremental mapping.

    Args:
        folder: of the photos.
        sweeps: name -> names of photos in ``folder``; no photo in two of them.
        out: folder for the model (``cameras.bin``, ``images.bin``, …, and its points in ``points3D.ply``).
        settings: None for the defaults.
        progress: called with a stage, how much of it is done, and how much there is.
        work: folder for features, matches and models, which stays; a call with the same photos, sweeps and settings
            goes on from what is there. None: a temporary one.

    Raises:
        ImportError: pycolmap is missing, does not load, or is too old.
        ValueError: no part has enough photos of every sweep; says how many each part has of each.
    """
    how = settings or PosingSettings()
    names = [name for photos in sweeps.values() for name in photos]
    if not names or len(set(names)) != len(names) or not all(sweeps.values()):
        raise InvalidArgument(f"pose_jointly: sweeps must have a photo each and share none, got {dict(sweeps)}")
    spaced = next((name for name in names if len(name.split()) != 1), None)
    if spaced is not None:
        raise InvalidArgument(f"pose_jointly: names of photos must have no spaces in them, got {spaced!r}")
    tell = progress or (lambda stage, done, total: None)
    place = tempfile.TemporaryDirectory() if work is None else nullcontext(str(work))
    with quiet_pycolmap("pose_jointly") as pycolmap, place as scratch:
        check_pycolmap(pycolmap, caller="pose_jointly")
        state, database = _State(Path(scratch)), Path(scratch, DATABASE)
        lenses = [names] if how.one_lens else [list(photos) for photos in sweeps.values()]
        if not state.features:
            for leftover in Path(scratch).glob(f"{DATABASE}*"):
                leftover.unlink()
            _extract(pycolmap, database, Path(folder), lenses, how, tell)
            state.save(features=True)
        match_pairs(
            pycolmap,
            database,
            names,
            seed=how.seed,
            threads=how.threads,
            tell=tell,
            first=state.pairs,
            matched=lambda pairs: state.save(pairs=pairs),
        )
        if not state.poses:
            shutil.rmtree(Path(scratch, PARTS), ignore_errors=True)
            parts = _map(pycolmap, database, Path(folder), Path(scratch, PARTS), len(names), how, tell)
            state.save(poses=True)
        else:
            parts = _stored(pycolmap, Path(scratch, PARTS))
        incremental = len(parts)
        if incremental > 1:
            parts += _join(pycolmap, database, Path(folder), Path(scratch, PARTS, GLOBAL), how, state, tell)
        counts = [_posed(part, sweeps) for part in parts]
        enough = [
            number
            for number, posed in enumerate(counts)
            if all(len(posed[sweep]) >= how.minimum_share * len(photos) for sweep, photos in sweeps.items())
        ]
        if not enough:
            kind = NotJoinedError if counts else InvalidArgument
            raise kind(_complaint(counts, sweeps, how.minimum_share, incremental))
        best = max(enough, key=lambda number: sum(map(len, counts[number].values())))
        model, posed = parts[best], counts[best]
        sizes = [sum(map(len, each.values())) for each in counts]
        Path(out).mkdir(parents=True, exist_ok=True)
        model.write_binary(out)
        model.export_PLY(Path(out, "points3D.ply"))
    found = {name for photos in posed.values() for name in photos}
    unposed = tuple(name for name in names if name not in found)
    return Posing(
        posed,
        unposed,
        float(model.compute_mean_reprojection_error()),
        int(model.num_points3D()),
        _mapping(sizes, incremental, best),
    )


def check_pycolmap(pycolmap: Any, *, caller: str) -> Any:
    """The module, if it has what is needed.

    Raises:
        ImportError: it has not; names its version and what it lacks.
    """
    lacking = [name for name in NEEDED if not hasattr(pycolmap, name)]
    if lacking:
        raise MissingExtra(
            f"{caller}: pycolmap {getattr(pycolmap, '__version__', '?')} lacks {', '.join(lacking)}: pip install "
            "'pycolmap>=4.2'"
        )
    return pycolmap


class _State:
    """How far the posing in a folder has come: features, matched pairs, poses, and global mapping begun and done."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / STATE
        stored = read_json(self._path, caller="pose_jointly") if self._path.is_file() else {}
        self.features: bool = stored.get("features", False)
        self.pairs: int = stored.get("pairs", 0)
        self.poses: bool = stored.get("poses", False)
        self.tried: bool = stored.get("tried", False)
        self.joined: bool = stored.get("joined", False)

    def save(self, **changes: Any) -> None:
        vars(self).update(changes)
        keys = ("features", "pairs", "poses", "tried", "joined")
        write_json(self._path, {key: getattr(self, key) for key in keys})


def _threads(how: PosingSettings) -> int:
    return how.threads or -1


def _extract(
    pycolmap: Any, database: Path, folder: Path, lenses: Sequence[Sequence[str]], how: PosingSettings, tell: Progress
) -> None:
    """Features of all photos; those of one entry of ``lenses`` share a camera, numbered from 1."""
    options = pycolmap.FeatureExtractionOptions(
        use_gpu=False, num_threads=_threads(how), max_image_size=how.longest_side
    )
    done, total = 0, sum(map(len, lenses))
    for camera, names in enumerate(lenses, start=1):
        for start in range(0, len(names), EXTRACT_AT_ONCE):
            tell("features", done, total)
            reader = pycolmap.ImageReaderOptions(camera_model="OPENCV")
            if start:
                reader.existing_camera_id = camera
            chosen = list(names[start : start + EXTRACT_AT_ONCE])
            pycolmap.extract_features(
                database,
                folder,
                image_names=chosen,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            done += len(chosen)
    tell("features", total, total)


def pairs_to_match(names: Sequence[str], overlap: int | None = None) -> list[tuple[str, str]]:
    """Pairs of photos: all of them, or those that a sequence makes likely to overlap.

    Args:
        names: of the photos; for a sequence, in the order in which they were taken.
        overlap: None for every pair, n (n - 1) / 2 of n photos. A number for sequential matching: each photo with the
            so many next ones, and with those 2, 4, 8, 16, … further on, which close loops of a walk: about
            n (overlap + log2(n / overlap)).

    Example:
        >>> [f"{one}{other}" for one, other in pairs_to_match("abcdef", 1)]
        ['ab', 'bc', 'cd', 'de', 'ef', 'ac', 'bd', 'ce', 'df', 'ae', 'bf']
    """
    if overlap is None:
        return list(combinations(names, 2))
    steps = sorted({*range(1, overlap + 1), *(1 << power for power in range(1, len(names).bit_length()))})
    return [pair for step in steps for pair in zip(names, names[step:])]


def match_pairs(
    pycolmap: Any,
    database: Path,
    names: Sequence[str],
    *,
    seed: int,
    threads: int,
    tell: Progress,
    overlap: int | None = None,
    first: int = 0,
    matched: Callable[[int], None] | None = None,
) -> None:
    """Match pairs of photos by their features, some hundred pairs at a time.

    Args:
        pycolmap: the module.
        database: COLMAP's, with the features of all photos; ``pairs.txt`` is written beside it.
        names: of the photos, in the order in which they were taken if ``overlap`` is a number.
        seed: of the verification's random choices.
        threads: 0 for one per core.
        tell: called with ``"pairs"``, how many are matched, and how many there are.
        overlap: None for every pair, else as in :func:`pairs_to_match`.
        first: pairs that are matched already.
        matched: called with the number of matched pairs after each part.
    """
    options = pycolmap.FeatureMatchingOptions(use_gpu=False, num_threads=threads or -1)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    chosen = pycolmap.ImportedPairingOptions()
    chosen.match_list_path = database.with_name("pairs.txt")
    pairs = pairs_to_match(names, overlap)
    for start in range(first, len(pairs), MATCH_AT_ONCE):
        tell("pairs", start, len(pairs))
        lines = (f"{one} {other}\n" for one, other in pairs[start : start + MATCH_AT_ONCE])
        database.with_name("pairs.txt").write_text("".join(lines), encoding="utf-8")
        pycolmap.match_image_pairs(
            database,
            matching_options=options,
            pairing_options=chosen,
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        if matched is not None:
            matched(start + MATCH_AT_ONCE)
    tell("pairs", len(pairs), len(pairs))


def _map(
    pycolmap: Any, database: Path, folder: Path, parts: Path, total: int, how: PosingSettings, tell: Progress
) -> list[Any]:
    """The parts that hang together, each a reconstruction."""
    options = pycolmap.IncrementalPipelineOptions(
        random_seed=how.seed, num_threads=_threads(how), min_model_size=SMALLEST_PART
    )
    options.mapper.random_seed = options.triangulation.random_seed = how.seed
    options.mapper.num_threads = _threads(how)
    steps = _counted(total, tell)
    parts.mkdir()
    found = pycolmap.incremental_mapping(
        database,
        folder,
        parts,
        options=options,
        initial_image_pair_callback=lambda: (next(steps), next(steps)),
        next_image_callback=lambda: next(steps),
    )
    return [found[number] for number in sorted(found)]


def _stored(pycolmap: Any, folder: Path) -> list[Any]:
    """The reconstructions that a mapping has written, by their numbers."""
    found = [path for path in folder.iterdir() if path.name.isdigit()] if folder.is_dir() else []
    return [pycolmap.Reconstruction(path) for path in sorted(found, key=lambda path: int(path.name))]


def _join(
    pycolmap: Any, database: Path, folder: Path, parts: Path, how: PosingSettings, state: _State, tell: Progress
) -> list[Any]:
    """Global mapping of all photos, which may join what incremental mapping did not; nothing if it cannot be done."""
    if not hasattr(pycolmap, "global_mapping") or (state.tried and not state.joined):
        return []  # where it took the process down before, it would again
    if not state.joined:
        shutil.rmtree(parts, ignore_errors=True)
        parts.mkdir(parents=True)
        state.save(tried=True)
        tell("joining", 0, 1)
        try:
            simple = _with_simple_lenses(pycolmap, database, parts / DATABASE)
            with suppress(RuntimeError, ValueError):  # COLMAP's own; the parts of incremental mapping are there
                pycolmap.global_mapping(simple, folder, parts, options=_global_options(pycolmap, how))
        except BaseException:
            state.save(tried=False)
            raise
        state.save(joined=True)
    tell("joining", 1, 1)
    return _stored(pycolmap, parts)


def _with_simple_lenses(pycolmap: Any, database: Path, target: Path) -> Path:
    """A copy of the database whose lenses are SIMPLE_RADIAL: one focal length, one distortion.

    Global mapping begins with all photos at once, and with the eight parameters of OPENCV it finds nothing, or a third,
    of photos (skull_flash, focal length 2263 pixels, begun from 1200) of which it poses 65 of 66 with this lens.
    """
    shutil.copyfile(database, target)
    with pycolmap.Database.open(target) as opened:
        for lens in opened.read_all_cameras():
            focal, center = lens.mean_focal_length(), (lens.principal_point_x, lens.principal_point_y)
            simple = pycolmap.Camera(
                camera_id=lens.camera_id,
                model="SIMPLE_RADIAL",
                width=lens.width,
                height=lens.height,
                params=[focal, *center, 0.0],
            )
            simple.has_prior_focal_length = lens.has_prior_focal_length
            opened.update_camera(simple)
    return target


def _global_options(pycolmap: Any, how: PosingSettings) -> Any:
    options = pycolmap.GlobalPipelineOptions(
        random_seed=how.seed, num_threads=_threads(how), min_model_size=SMALLEST_PART
    )
    mapper = options.mapper
    mapper.random_seed, mapper.num_threads = how.seed, _threads(how)
    for step in (mapper.rotation_averaging, mapper.global_positioning, mapper.retriangulation):
        step.random_seed = how.seed
    mapper.global_positioning.use_gpu = mapper.bundle_adjustment.ceres.use_gpu = False
    return options


def _mapping(sizes: Sequence[int], incremental: int, best: int) -> str:
    """One line: which mapping the chosen part is from, and what the other one came to.

    Example:
        >>> _mapping([40, 20, 65], 2, 2)
        'global mapping, 65 photos; incremental mapping split them into parts of 40, 20'
    """
    split = ", ".join(map(str, sizes[:incremental]))
    if best >= incremental:
        return f"global mapping, {sizes[best]} photos; incremental mapping split them into parts of {split}"
    if incremental == 1:
        return f"incremental mapping, {sizes[best]} photos"
    joined = max(sizes[incremental:], default=0)
    return f"incremental mapping, {sizes[best]} photos of parts of {split}; global mapping joined {joined}"


def _counted(total: int, tell: Progress) -> Iterator[None]:
    """Tells of one photo more each time it is asked; COLMAP may begin anew, so it stops at the total."""
    done = 0
    while True:
        done = min(done + 1, total)
        tell("poses", done, total)
        yield


def _posed(model: Any, sweeps: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    names = {photo.name for photo in model.images.values() if photo.has_pose}
    return {sweep: tuple(name for name in photos if name in names) for sweep, photos in sweeps.items()}


def _complaint(
    counts: Sequence[Mapping[str, tuple[str, ...]]], sweeps: Mapping[str, Sequence[str]], share: float, incremental: int
) -> str:
    """Why no part will do."""
    told = [", ".join(f"{sweep} {len(posed[sweep])} of {len(sweeps[sweep])}" for sweep in sweeps) for posed in counts]
    if not told:
        none = ", ".join(f"{sweep} 0 of {len(photos)}" for sweep, photos in sweeps.items())
        return (
            f"pose_jointly: COLMAP posed no photos ({none}): they must be sharp, show texture, overlap, and be taken "
            "from different places"
        )
    kinds = ["part" if number < incremental else "by global mapping, part" for number in range(len(told))]
    parts = "; ".join(f"{kind} {number}: {text}" for number, (kind, text) in enumerate(zip(kinds, told), start=1))
    return (
        f"pose_jointly: no part joins at least {share:.0%} of each sweep. COLMAP posed {parts}. "
        "The sweeps must show the same things from not too different places; more frames may help"
    )
