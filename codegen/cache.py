"""A user's folder of compiled libraries, addressed by their ingredients.

Every library has a manifest beside it, which is written last and holds the checksums of both. So an
interrupted or damaged build is not found and is made again. Files appear by renaming, so two
processes that build the same library do no harm; a lock per key avoids the second build.

Files of the folder are loaded as code. So the folder and its files must belong to the user and be
writable by nobody else, and nobody else may be able to replace the folder.
"""

from __future__ import annotations

import ast
import fcntl
import hashlib
import importlib.util
import json
import os
import re
import shutil
import stat
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import cache, partial
from importlib.metadata import version
from pathlib import Path
from typing import Any, TypeVar

import platformdirs

from codegen.errors import CodegenError
from symbolic import safe_io
from symbolic.errors import OutsideError
from symbolic.safe_io import replace_file

CACHE_FORMAT = 1
"""Part of every key. It rises when stored content changes its meaning."""

_SOURCES = {".py", ".c", ".h"}

Found = TypeVar("Found")

_STALE_SECONDS = 3600.0
_MOST_BYTES = 256 * safe_io.MEBIBYTE

MOST_KEPT = 4 * 2**30
"""Above this size a cache removes what was not used for longest [bytes]."""

_NOTED_SECONDS = 3600.0
"""Least time between two recorded uses of an entry [s]."""

_KEPT = {".so", ".o", ".json", ".lock", ".draft"}
_KEY_END = re.compile("[-.]")


def key_of(what: str, **parts: object) -> str:
    """Return the key of a cache entry: a digest of its kind and of all its ingredients.

    Every key of a cache is computed here. Some kinds and their ingredients::

      library        text of the source, compiler, its level and flags (`codegen.build`)
      part           the same for an object file that several libraries share
      set            key of the set's recipe, lanes and levels, compiler, CasADi, code of `codegen`
      recipe         topology of a cell, and the code that makes its expressions
                     (`hybrid_opt.compiled_cell`)
      code           sources of packages, without comments (`Cache.code_digest`)
      compiler       type of processor (`codegen.build.compiler_of`)

    Args:
        what: kind of the entry.
        parts: its ingredients by name.
    """
    named = [f"{name}={value}" for name, value in sorted(parts.items())]
    return digest(what, str(CACHE_FORMAT), *named)


def digest(*parts: str | bytes) -> str:
    """Compute the SHA-256 of the parts, each prefixed with its length."""
    total = hashlib.sha256()
    for part in parts:
        raw = part.encode() if isinstance(part, str) else part
        total.update(len(raw).to_bytes(8, "big"))
        total.update(raw)
    return total.hexdigest()


@cache
def library_version(name: str) -> str:
    """Return the version of an installed library, cached since the look-up takes milliseconds."""
    return version(name)


def source_digest(*packages: str) -> str:
    """Compute the SHA-256 of the Python and C sources of installed packages and modules. Nothing is
    imported."""
    total: list[str | bytes] = []
    for name, file in _sources(packages):
        total += [name, file.read_bytes()]
    return digest(*total)


def _code(file: Path) -> str | bytes:
    """Return the part of a source that has an effect: a Python file without comments and
    docstrings."""
    raw = file.read_bytes()
    if file.suffix != ".py":
        return raw
    return ast.dump(_Undocumented().visit(ast.parse(raw)))


class _Undocumented(ast.NodeTransformer):
    def visit_Expr(self, node: ast.Expr) -> ast.Expr | None:
        said = isinstance(node.value, ast.Constant) and isinstance(node.value.value, str)
        return None if said else node


def _sources(packages: Sequence[str]) -> Iterator[tuple[str, Path]]:
    """Yield (name, path) of every source file of packages or modules.

    The name is the package and the file's own name; it does not depend on the folder of
    installation.
    """
    for package in packages:
        spec = importlib.util.find_spec(package)
        if spec is None:
            continue
        folders = spec.submodule_search_locations
        if folders is None and spec.origin is not None:
            yield package, Path(spec.origin)
        files = [path for folder in folders or () for path in Path(folder).rglob("*")]
        for file in sorted(path for path in files if path.suffix in _SOURCES):
            yield f"{package}/{file.name}", file


def largest_size() -> int:
    """Return the size [bytes] above which `Cache.trim` removes files.

    Raises:
        CodegenError: the environment variable DUAL_ARM_CACHE_LIMIT is not a number.
    """
    own = os.environ.get("DUAL_ARM_CACHE_LIMIT", "")
    try:
        return int(float(own) * 2**30) if own.strip() else MOST_KEPT
    except (ValueError, OverflowError):
        raise CodegenError(
            f"the environment variable DUAL_ARM_CACHE_LIMIT holds {own[:40]!r}; allowed is a "
            "number of gibibytes",
            code="cache-limit",
        ) from None


def default_folder() -> Path:
    """Return the folder in DUAL_ARM_CACHE if set, otherwise `dual-arm-carry` in the user's cache
    folder (XDG_CACHE_HOME, by default ~/.cache)."""
    own = os.environ.get("DUAL_ARM_CACHE", "")
    return Path(own).expanduser() if own else platformdirs.user_cache_path("dual-arm-carry")


@dataclass(frozen=True)
class Usage:
    """Content of a cache: number of libraries, and the total size of all files [bytes]."""

    libraries: int
    files: int
    size: int


@dataclass(frozen=True)
class CacheEntry:
    """A library in the cache with verified content.

    Attributes:
        key: key of the entry.
        library: path of the shared library.
        facts: facts that were stored with the library.
    """

    key: str
    library: Path
    facts: dict[str, Any]


class Cache:
    """A cache folder: it checks the folder's safety, finds, stores and removes files."""

    def __init__(self, folder: Path | None = None) -> None:
        self.folder = Path(os.path.abspath(folder if folder is not None else default_folder()))

    def find(self, key: str) -> CacheEntry | None:
        """Return the entry of this key, or None if it is missing or damaged.

        Raises:
            CodegenError: somebody other than the user can write to the folder or the file.
        """
        facts = self.read_record(key)
        if facts is None:
            return None
        name = facts.get("library")
        if not isinstance(name, str) or "/" in name:
            return None
        library = self.folder / name
        content = self._read_own(library)
        if content is None or hashlib.sha256(content).hexdigest() != facts.get("sha256"):
            return None
        return CacheEntry(key, library, facts)

    def store(
        self, key: str, make: Callable[[Path], Mapping[str, Any]], suffix: str = ".so"
    ) -> CacheEntry:
        """Make a library and store it under this key, replacing an existing one.

        Args:
            key: key of the entry, from `key_of`.
            make: function that writes the library to the given path, in a separate folder, and
                returns further facts to store.
            suffix: suffix of the file; object files are stored in the same way.

        Raises:
            CodegenError: the folder is unsafe or cannot be written to.
        """
        with self.build_folder() as scratch:
            built = scratch / f"library{suffix}"
            with _writing(self.folder):
                facts = dict(make(built))
                checksum = hashlib.sha256(built.read_bytes()).hexdigest()
                library = self.folder / f"{key}-{checksum[:16]}{suffix}"
                built.chmod(0o700)
                built.replace(library)
        facts |= {"library": library.name, "sha256": checksum}
        self.write_record(key, facts)
        return CacheEntry(key, library, facts)

    def read_record(self, key: str) -> dict[str, Any] | None:
        """Return the JSON object that `write_record` stored under a key; None if missing or
        damaged.
        """
        self._require_safe()
        raw = self._read_own(self.folder / f"{key}.json")
        if raw is None:
            return None
        try:
            stored = safe_io.json_value(raw)
            facts = stored["facts"]
            intact = stored["sha256"] == digest(_canonical(facts))
        except (OutsideError, KeyError, TypeError):
            return None
        if not intact or not isinstance(facts, dict):
            return None
        with suppress(OSError):  # others may own it, or it is gone
            path = self.folder / f"{key}.json"
            if time.time() - path.stat().st_mtime > _NOTED_SECONDS:
                os.utime(path)
        return facts

    def write_record(self, key: str, facts: Mapping[str, Any]) -> None:
        """Store a JSON object `facts` under a key, with its checksum. Readers see the old file or
        the complete new one, never a part."""
        text = json.dumps({"facts": facts, "sha256": digest(_canonical(facts))}, indent=1)
        self._make_folder()
        with _writing(self.folder):
            replace_file(self.folder / f"{key}.json", text.encode(), 0o600)

    def obtain(
        self,
        key: str,
        find: Callable[[], Found | None],
        make: Callable[[], Found],
        *,
        anew: bool = False,
    ) -> tuple[Found, bool]:
        """Return the value stored under a key. If it is missing, exactly one process makes it.

        Args:
            key: key of the value.
            find: function that loads the value; None if it is missing, damaged or cannot be loaded.
            make: function that makes and stores the value.
            anew: True to make the value even if it is stored.

        Returns:
            The value, and True if it was already stored.
        """
        # A lock writes: what is there already needs none.
        found = None if anew else find()
        if found is not None:
            return found, True
        with self.lock(key):
            found = None if anew else find()
            return (make(), False) if found is None else (found, True)

    def code_digest(self, *packages: str) -> str:
        """Compute the SHA-256 of packages' sources without comments and docstrings.

        Parsing takes a while, so the result is cached under the digest of the unchanged sources.
        """
        key = key_of("code", sources=source_digest(*packages))
        record = self.read_record(key)
        if record is None:
            parts = [part for name, file in _sources(packages) for part in (name, _code(file))]
            record = {"digest": digest(*parts)}
            self.write_record(key, record)
        return str(record["digest"])

    @contextmanager
    def lock(self, key: str) -> Iterator[None]:
        """Keep other processes and threads from building the same key during the `with` block.

        The lock only saves work. On a file system without locks it does nothing.
        """
        self._make_folder()
        with _writing(self.folder):
            handle = os.open(self.folder / f"{key}.lock", os.O_RDWR | os.O_CREAT, 0o600)
        try:
            with suppress(OSError):
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield
        finally:
            os.close(handle)

    def usage(self) -> Usage:
        """Return the number of libraries and the total size of all files."""
        kept = self._by_use()
        files = [file for *_, files in kept for file in files]
        libraries = sum(file.suffix == ".so" for file in files)
        return Usage(libraries, len(files), sum(size for _, size, _ in kept))

    def trim(self, most: int | None = None) -> int:
        """Remove the least recently used files until the rest is at most `most` bytes.

        Removed libraries are made again when they are needed.

        Args:
            most: size to keep [bytes]; None for the limit in DUAL_ARM_CACHE_LIMIT (gibibytes), by
                default `MOST_KEPT`.

        Returns:
            The number of libraries removed.

        Raises:
            CodegenError: the environment variable is not a number.
        """
        most = largest_size() if most is None else most
        kept = self._by_use()
        size, libraries = sum(each for _, each, _ in kept), 0
        for _, own, files in kept:
            if size <= most:
                break
            size -= own
            libraries += sum(path.suffix == ".so" for path in files)
            with _writing(self.folder):
                for path in files:
                    path.unlink(missing_ok=True)
        return libraries

    def _by_use(self) -> list[tuple[float, int, list[Path]]]:
        """Return (time of last use [s], total size [bytes], files) of every key, oldest first."""
        found: dict[str, tuple[float, int, list[Path]]] = {}
        if self.folder.exists():
            self._require_safe()
            for entry in os.scandir(self.folder):
                with suppress(OSError):  # another process removed it
                    if entry.is_file() and Path(entry.name).suffix in _KEPT:
                        key, own = _KEY_END.split(entry.name, 1)[0], entry.stat()
                        used, size, files = found.get(key, (0.0, 0, []))
                        files = [*files, Path(entry.path)]
                        found[key] = max(used, own.st_mtime), size + own.st_size, files
        return sorted(found.values(), key=lambda each: each[0])

    def clean(self) -> int:
        """Remove everything this cache has stored; return the number of libraries removed."""
        libraries = self.trim(-1)
        for left in self.folder.glob("build-*"):
            shutil.rmtree(left, ignore_errors=True)
        return libraries

    @contextmanager
    def build_folder(self) -> Iterator[Path]:
        """Make a folder for the files of a build, locked against `_sweep`, and remove it after the
        `with` block.

        Raises:
            CodegenError: the cache is unsafe or cannot be written to.
        """
        self._make_folder()
        self._sweep()
        with _writing(self.folder):
            scratch = Path(tempfile.mkdtemp(prefix="build-", dir=self.folder))
            handle = os.open(scratch, os.O_RDONLY)
        try:
            with suppress(OSError):  # where the file system has no locks
                fcntl.flock(handle, fcntl.LOCK_EX)
            yield scratch
        finally:
            shutil.rmtree(scratch, ignore_errors=True)
            os.close(handle)

    def _sweep(self) -> None:
        """Remove the folders of builds that were killed long ago.

        A running build holds a lock, so a jump of the clock does not remove its folder.
        """
        for left in self.folder.glob("build-*"):
            with suppress(OSError):
                if abs(time.time() - left.stat().st_mtime) > _STALE_SECONDS and _unlocked(left):
                    shutil.rmtree(left, ignore_errors=True)

    def _make_folder(self) -> None:
        with _writing(self.folder):
            missing = [self.folder, *self.folder.parents]
            for folder in reversed([path for path in missing if not path.exists()]):
                folder.mkdir(mode=0o700, exist_ok=True)
        self._require_safe()

    def _require_safe(self) -> None:
        """Check that nobody else can write to the folder or replace it.

        Raises:
            CodegenError: somebody else can.
        """
        try:
            own = self.folder.stat()
        except FileNotFoundError:
            return
        except OSError as error:
            raise CodegenError(_cannot_use(self.folder, error)) from error
        if not stat.S_ISDIR(own.st_mode):
            raise CodegenError(
                f"the cache {self.folder} is not a folder; {_OTHER_FOLDER}", code="no-folder"
            )
        _require_own(self.folder, own)
        for parent in dict.fromkeys([*self.folder.parents, *self.folder.resolve().parents]):
            mode = parent.stat().st_mode
            if mode & (stat.S_IWGRP | stat.S_IWOTH) and not mode & stat.S_ISVTX:
                raise CodegenError(
                    f"compiled code in the cache {self.folder} is refused: others can write to "
                    f"{parent} (mode {stat.S_IMODE(mode):04o}) and could exchange it; run "
                    f"`chmod go-w {parent}`, or {_OTHER_FOLDER}",
                    code="exchangeable-by-others",
                )

    def _read_own(self, path: Path) -> bytes | None:
        """Return the content of a file that only the user can have written; None if it is
        missing."""
        try:
            found = path.stat()
            if not stat.S_ISREG(found.st_mode):
                return None
            return safe_io.read_bytes(path, _MOST_BYTES, partial(_require_own, path))
        except FileNotFoundError:
            return None
        except OSError as error:
            raise CodegenError(_cannot_use(path, error), code="cache-unusable") from error
        except OutsideError as error:
            raise CodegenError(
                f"the cache of compiled functions cannot be used: {path} {error}; grant access "
                f"there, or {_OTHER_FOLDER}"
            ) from error


def _unlocked(folder: Path) -> bool:
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(handle)
    return True


_OTHER_FOLDER = "name another folder in the environment variable DUAL_ARM_CACHE"


def _canonical(facts: Mapping[str, Any]) -> str:
    return json.dumps(facts, sort_keys=True, separators=(",", ":"))


def _cannot_use(path: Path, error: OSError) -> str:
    return (
        f"the cache of compiled functions cannot be used: {path}: {error.strerror or error}; make "
        f"room or grant access there, or {_OTHER_FOLDER}"
    )


def _require_own(path: Path, found: os.stat_result) -> None:
    if found.st_uid != os.geteuid():
        raise CodegenError(
            f"compiled code in {path} is refused: it belongs to user {found.st_uid}, not to you "
            f"({os.geteuid()}); remove it, or {_OTHER_FOLDER}",
            code="owned-by-another",
        )
    if found.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        raise CodegenError(
            f"compiled code in {path} is refused: others can write to it (mode "
            f"{stat.S_IMODE(found.st_mode):04o}); if you trust its content, run "
            f"`chmod go-w {path}`, otherwise remove it, or {_OTHER_FOLDER}",
            code="writable-by-others",
        )


@contextmanager
def _writing(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise CodegenError(_cannot_use(folder, error), code="cache-unusable") from error
