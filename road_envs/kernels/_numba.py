"""Compilation of the numerical kernels, and where the compiled code is cached.

A kernel is a module-level function of scalars, arrays and records of numbers; it writes into
arrays handed to it, calls other kernels directly and never receives a function as argument.

Numba's own disk cache is keyed by the file of a function and the line it stands in: it misses a
change in a callee, and compiles again after any edit of a comment. Here the cache folder is named
after the code of all files that hold kernels and of what these import, and inside it a kernel is
found by its module and name. A kernel is compiled by one process at a time; others that need it
wait and load it: Numba's index of a kernel's signatures is not safe against two writers.

A kernel that is called by another one is a part of it: it gets no machine code, no wrapper for
Python and no place in the cache of its own, which halves the time to a first step.

This is the one module that imports private parts of Numba (below `numba.core` and `numba.np`),
which may change with any release: `pyproject.toml` has an upper bound of its version.
"""

import logging
import sys
from collections.abc import Callable
from contextlib import suppress
from functools import cache, partial
from pathlib import Path
from typing import Any, TypeVar, overload

import numba
from numba.core import caching, cgutils, compiler, sigutils, types
from numba.core.codegen import JITCodeLibrary
from numba.core.compiler_lock import global_compiler_lock
from numba.core.runtime import rtsys
from numba.core.targetconfig import ConfigStack
from numba.core.typing import templates
from numba.core.typing.templates import AbstractTemplate, infer_global, signature
from numba.np.random import _constants as ziggurat

from road_envs.core.atomic_io import exclusive_lock
from road_envs.core.code_digest import cache_home, closure, digest, importers

__all__ = [  # of Numba's private parts, those that other modules of this folder need
    "AbstractTemplate", "cgutils", "infer_global", "populate_array", "signature", "ziggurat",
]  # fmt: skip

F = TypeVar("F", bound=Callable[..., Any])
HERE = Path(__file__).parents[1]
MAX_WAIT = 300.0  # longest wait [s] for another process that compiles a kernel; then also here


def populate_array(*args: Any, **fields: Any) -> Any:
    """Fill the structure of an array, as `numba.np.arrayobj.populate_array`."""
    from numba.np import arrayobj  # slow to import, and needed only where a kernel is compiled

    return arrayobj.populate_array(*args, **fields)


def _kernel_files(folder: Path) -> list[Path]:
    """Files of a package that hold kernels, and all files of this project that they import."""
    files = importers(folder, __name__)
    root = folder.parent
    names = [".".join(path.relative_to(root).with_suffix("").parts) for path in files]
    return [*files, *closure(*names, root=root)]


# folder of the compiled kernels of this package; those of other packages stand in it
CACHE = cache_home() / digest(_kernel_files(HERE))


@cache
def _cache_of(name: str) -> Path:
    """Return the folder for compiled kernels of a top-level package or module."""
    module = sys.modules.get(name)
    folders = [Path(folder) for folder in getattr(module, "__path__", ())]
    if not folders or HERE in folders:
        return CACHE
    return CACHE / digest(path for folder in folders for path in _kernel_files(folder))


class _Locator(caching._CacheLocator):
    """Place of one kernel in the cache: by module and name, whatever line it stands in."""

    def __init__(self, py_func: Any, py_file: str):
        self._py_file, self._module = py_file, py_func.__module__
        self._cache_path = str(_cache_of(self._module.partition(".")[0]))

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> "_Locator | None":
        """Return the locator of a kernel; None where its folder cannot be written."""
        locator = cls(py_func, py_file)
        try:
            locator.ensure_cache_path()
        except OSError:
            return None
        return locator

    def get_cache_path(self) -> str:
        """Return the folder of the package's kernels."""
        return self._cache_path

    def get_source_stamp(self) -> str:
        """Return nothing that changes: the name of the folder is the digest of the code."""
        return ""

    def get_disambiguator(self) -> str:
        """Return the module, since two may have kernels of one name."""
        return self._module


class _Implementation(caching.CompileResultCacheImpl):
    _locator_classes = [_Locator]  # noqa: RUF012  numba's own attribute


class _KernelCache(caching.FunctionCache):
    _impl_class = _Implementation

    def __init__(self, function: Any, counts_references: bool):
        super().__init__(function)
        self.counts_references = counts_references

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Load compiled code without numba's registries, a third of the time to the first step.

        A compilation that follows loads them. Nor is Numba's runtime, which itself is compiled in
        every process, needed by code that counts no references.
        """
        if self.counts_references:
            rtsys.initialize(target_context)
        compiled = None
        with self._guard_against_spurious_io_errors():
            compiled = self._load_overload(sig, target_context)
        if compiled is None:
            _announce_compilation()
        return compiled


class _PartOfKernel(JITCodeLibrary):
    """Code of a kernel inside another one, which is optimised and emitted with it."""

    def _optimize_final_module(self) -> None:
        """Leave the optimisation to the kernel that this is a part of."""

    def _finalize_final_module(self) -> None:
        self._finalized = True


class _InKernels:
    """Typing of a dispatcher for numba where compiled code calls it.

    `compiled`: signature, key of the code, by argument types and whether references are counted.
    """

    def __init__(self, dispatcher: Any):
        self.dispatcher, self.compiled = dispatcher, dict[Any, Any]()

    def get_call_template(self, args: Any, kws: Any) -> Any:
        """Return the typing of a call, as `Dispatcher.get_call_template`; compile if needed."""
        name = self.dispatcher.py_func.__name__
        pysig, folded = self.dispatcher._compiler.fold_argument_types(args, kws)
        kinds = tuple(map(types.unliteral, folded))  # one code for all wheels, not one for each
        counted = bool(ConfigStack().top().nrt)
        if (kinds, counted) not in self.compiled:
            self.compiled[kinds, counted] = self._compile(kinds, counted)
        signatures = [self.compiled[kinds, counted][0]]
        typing = templates.make_concrete_template(name, key=name, signatures=signatures)
        return typing, pysig, kinds, {}

    def get_overload(self, sig: Any) -> Any:
        """Return the key of the code for a signature, as `Dispatcher.get_overload`."""
        kinds = tuple(sigutils.normalize_signature(sig)[0])
        return self.compiled[kinds, bool(ConfigStack().top().nrt)][1]

    def _compile(self, kinds: Any, counted: bool) -> Any:
        kernel = self.dispatcher
        flags: Any = compiler.Flags()
        kernel.targetdescr.options.parse_as_flags(flags, kernel.targetoptions)
        target = kernel.targetctx
        flags.no_compile = flags.no_cpython_wrapper = flags.no_cfunc_wrapper = True
        flags.nrt = counted
        library = _PartOfKernel(target.codegen(), kernel.py_func.__qualname__)
        result = compiler.compile_extra(
            kernel.typingctx, target, kernel.py_func, kinds, None, flags, {}, library=library
        )
        key = self, kinds, counted
        target.insert_user_function(key, result.fndesc, [library])
        return result.signature, key


@cache
def _announce_compilation() -> None:
    """Log once why the first step takes long; `logging` shows warnings by default."""
    logging.getLogger("road_envs").warning(
        "compiling the simulator's kernels: up to half a minute, once for each version"
    )


@overload
def kernel(function: F) -> F: ...
@overload
def kernel(*, inline: bool = True, count_references: bool = True) -> Callable[[F], F]: ...
def kernel(
    function: F | None = None, *, inline: bool = True, count_references: bool = True
) -> F | Callable[[F], F]:
    """Compile with `numba.njit`, cached on disk and inlined into every caller.

    Inlined kernels run 2.5 times faster than called ones; `inline=False` is for what is large and
    called seldom, so that it compiles once. IEEE arithmetic, except that a*b + c may be contracted
    and x / c become x * (1 / c).

    Where neither a kernel nor those that it calls create or return an array, it need not
    `count_references` to arrays: a view in a loop may take longer than the arithmetic on it, since
    the counters are atomic. Numba refuses to compile it if it does create one.
    """
    if function is None:
        return partial(kernel, inline=inline, count_references=count_references)
    options: Any = {"fastmath": {"contract", "arcp"}, "nogil": True, "_nrt": count_references}
    compiled: Any = numba.njit(error_model="numpy", forceinline=inline, **options)(function)
    if hasattr(compiled, "_cache"):  # NUMBA_DISABLE_JIT leaves a plain function
        with suppress(RuntimeError):  # nowhere to write: compiled anew in every process
            compiled._cache = _KernelCache(function, count_references)  # as `cache=True`
            name = f"{function.__module__}.{function.__name__}.lock"
            lock = Path(compiled._cache.cache_path, name)
            compile_signature = compiled.compile

            # locks are taken from callers to callees, inside that of this process: no deadlock
            def compile_alone(sig: Any) -> Any:
                with global_compiler_lock, exclusive_lock(lock, MAX_WAIT):
                    return compile_signature(sig)

            compiled.compile = compile_alone
        inside = _InKernels(compiled)
        compiled.get_call_template = inside.get_call_template
        compiled.get_overload = inside.get_overload
    return compiled
