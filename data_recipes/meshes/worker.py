"""The process in which mesh files are read for :mod:`.guard`: few rights, little memory, one file after another.

It answers in JSON and raw numbers, so that nothing of a file is ever unpickled or evaluated by the one who asks.
"""

from __future__ import annotations

import dataclasses
import json
import os
import sys
import time
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import numpy as np

from .files import MeshFile, normalise, read_mesh_file
from .reading import MeshEmpty, MeshRejected
from .repair import RepairOptions, repair_triangles

_GRACE = 5.0  # seconds after the asker's limit at which an orphan ends itself
_WRITING = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC | os.O_APPEND
_FORBIDDEN = (
    "socket.",
    "urllib.",
    "http.",
    "ftplib.",
    "smtplib.",
    "subprocess.",
    "os.system",
    "os.exec",
    "os.fork",
    "os.spawn",
    "os.posix_spawn",
    "os.startfile",
    "pty.",
    "os.remove",
    "os.rename",
    "os.rmdir",
    "os.mkdir",
    "os.link",
    "os.symlink",
    "os.chmod",
    "os.chown",
    "os.truncate",
    "os.kill",
    "shutil.",
    "tempfile.",
    "webbrowser.",
)


class Fence:
    """An audit hook: no network, no other process, no writing, and no reading but of the libraries and one folder.

    It binds Python code, which all readers here are; it is the second wall, behind the readers' own checks of names.
    """

    def __init__(self) -> None:
        self.libraries = tuple(
            os.path.realpath(path) for path in {*sys.path, sys.prefix, sys.base_prefix, sys.exec_prefix} if path
        )
        self.root = ""

    def __call__(self, event: str, arguments: tuple[Any, ...]) -> None:
        """Refuse what is not allowed.

        Raises:
            PermissionError: the event is forbidden.
        """
        if event.startswith(_FORBIDDEN):
            raise PermissionError(f"{event} is forbidden while a mesh file is read")
        if event == "open" and isinstance(arguments[0], (str, bytes)):
            path = os.path.realpath(os.fsdecode(arguments[0]))
            within = any(path == folder or path.startswith(folder + os.sep) for folder in (*self.libraries, self.root))
            if not within or (len(arguments) > 2 and isinstance(arguments[2], int) and arguments[2] & _WRITING):
                raise PermissionError(f"opening {path} is forbidden while a mesh file is read")


def limit_memory(megabytes: int) -> bool:
    """Let this process grow by ``megabytes`` of address space and no more; whether the platform can do so."""
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
        most = pages * resource.getpagesize() + (megabytes << 20)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))
        resource.setrlimit(resource.RLIMIT_AS, (most, most))
    except (ImportError, OSError, ValueError):
        return False
    return True


def repaired(mesh: MeshFile, options: RepairOptions) -> MeshFile:
    """The mesh with its triangles repaired, and normalised anew."""
    triangles, center, extent, dropped = normalise(repair_triangles(mesh.triangles, options=options).triangles)
    return dataclasses.replace(
        mesh,
        triangles=triangles,
        center=mesh.center + mesh.extent * center,
        extent=mesh.extent * extent,
        dropped=mesh.dropped + dropped,
    )


def answer(path: str, root: str, repair: RepairOptions | None = None) -> tuple[dict[str, Any], MeshFile | None]:
    """How reading one file, and repairing it if asked, ends: the record to send, and what was read."""
    begun = time.perf_counter()
    mesh, again = None, True
    try:
        mesh = read_mesh_file(path, root=root)
        mesh = mesh if repair is None else repaired(mesh, repair)
        status, reason = "loaded", ""
    except MeshEmpty as error:
        status, reason = "empty", str(error)
    except (MeshRejected, ImportError, FileNotFoundError) as error:
        status, reason = "rejected", str(error)
    except MemoryError:
        mesh, status, reason, again = None, "rejected", "it needs more memory than is allowed", False
    except Exception as error:  # whatever a reader did not foresee costs the file, never the run
        mesh, status, reason = None, "rejected", f"{type(error).__name__}: {str(error)[:200]}"
    record: dict[str, Any] = {
        "status": status,
        "reason": reason,
        "again": again,
        "seconds": time.perf_counter() - begun,
    }
    if mesh is not None:
        record |= {
            "shape": list(mesh.triangles.shape),
            "center": mesh.center.tolist(),
            "extent": mesh.extent,
            "dropped": mesh.dropped,
            "sha256": mesh.sha256,
            "side_files": mesh.side_files,
        }
    return record, mesh


def main(handle: int, megabytes: int) -> None:
    """Serve requests from the inherited connection ``handle`` until it is closed.

    A request is ``{"path", "root", "seconds", "cpu", "repair"}``, the last null or the options' values; the answer
    is ``begun``, then a JSON record, followed by the triangles' bytes (float64, C order) where the file was loaded.
    """
    import signal

    connection = Connection(handle)
    sys.dont_write_bytecode = True
    try:
        import trimesh.exchange.load  # noqa: F401
    except ImportError:
        connection.send_bytes(json.dumps({"missing": "trimesh"}).encode())
        return
    fence = Fence()
    capped = limit_memory(megabytes)
    sys.addaudithook(fence)
    connection.send_bytes(json.dumps({"capped": capped}).encode())
    while True:
        try:
            request = json.loads(connection.recv_bytes())
        except EOFError:
            return
        connection.send_bytes(b"begun")  # from here on, dying is the file's doing
        fence.root = os.path.realpath(request["root"])
        signal.setitimer(signal.ITIMER_PROF, request["cpu"])  # what these clocks send ends the process by default
        signal.setitimer(signal.ITIMER_REAL, request["seconds"] + _GRACE)
        repair = RepairOptions(**request["repair"]) if request["repair"] is not None else None
        record, mesh = answer(request["path"], request["root"], repair)
        connection.send_bytes(json.dumps(record).encode())
        if mesh is not None:
            connection.send_bytes(np.ascontiguousarray(mesh.triangles, dtype=np.float64).data.cast("B"))
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.setitimer(signal.ITIMER_REAL, 0)
