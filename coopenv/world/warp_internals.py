"""All uses of Warp's private interface; `pyproject.toml` bounds the version of Warp because of them.

| function | private names | reason |
|---|---|---|
| `replay_of` | `context._build_cpu_args_structs`, `command.hooks.forward` | launch in a microsecond |
| `device_function`, `subroutine` | `Function.__class__`, `inline_hint`, `overload.adj` | records by reference |
| `struct_of`, `field_types` | `StructInstance._cls`, `Struct.vars` | fields of a record |
| `scalar_of` | `_wp_scalar_type_` | the NumPy type of an array of vectors |
| `cpu_features` | `context._get_cpu_feature_set` | the processor, as LLVM names it |
| `_kernel_source` | `codegen.codegen_kernel`, `Adjoint.args` | no copies of records; no kernels of the host on CUDA |
| `_function_source` | `codegen.codegen_func`, `codegen.cpu_module_header` | CPU: indices and loops as in C, calls |
| `_module_source` | `ModuleBuilder`, its `codegen` and fields | CPU: several worlds at once, no copies of arrays |

The last three stand in Warp for the whole process. Kernels and functions of other modules get the source that Warp
gives them; all that their modules have more is the namespace `coopenv`, with one template.
"""

import ctypes
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from hashlib import sha256
from pathlib import Path
from typing import Any

import warp as wp
from warp._src import codegen, context

from coopenv.base.plugins import loaded, own

SOURCE_RULES = sha256(Path(__file__).read_bytes()).hexdigest()[:16]
"""Digest of this file, an option of every module: Warp's hash of a module does not see the rules for its source."""


def cpu_features() -> frozenset[str]:
    """Return LLVM's names of the features of this processor; Warp must be initialised."""
    return frozenset(context._get_cpu_feature_set())


def replay_of(command: Any) -> Callable[[], Any]:
    """Return a function that runs a recorded launch again.

    On the CPU Warp packs the arguments, some kilobytes, anew at every launch, which takes longer than the launch.
    """
    if not command.device.is_cpu or command.block_dim > 1:
        return lambda: command.launch()
    packed, _ = context._build_cpu_args_structs(command.kernel, command.hooks, command.params, False)
    call = partial(command.hooks.forward, ctypes.byref(command.params[0]), ctypes.byref(packed))
    call.command = command  # type: ignore[attr-defined]  # owns the module and the arrays
    return call


_REFERENCE: Any = wp.ref  # generic at run time only


class _ByReference(wp.Function):
    """A Warp function whose overloads take their records by reference."""

    def get_overload(self, arg_types: Any, kwarg_types: Mapping[str, Any]) -> Any:
        """Return the overload for types of arguments, see `wp.Function`."""
        overload: Any = super().get_overload([codegen.strip_reference(kind) for kind in arg_types], kwarg_types)
        if overload is not None:
            given = overload.input_types.items()
            types = {name: _REFERENCE[kind] if _has_arrays(kind) else kind for name, kind in given}
            if types != overload.input_types:
                overload.input_types = types
                overload.adj = type(overload.adj)(overload.func, types, source=overload.adj.source)
        return overload


def _has_arrays(kind: Any) -> bool:
    """Return whether a type is a `wp.struct` with arrays, its own or a nested struct's."""
    fields = getattr(kind, "vars", {}).values()
    return any(isinstance(field.type, wp.array) or _has_arrays(field.type) for field in fields)


ELEMENT = """
namespace coopenv {{
template <typename T, typename... Indices>
CUDA_CALLABLE inline T& element(const wp::array_t<T>& array, Indices... indices)
{{
    return *wp::data_at_byte_offset(array, wp::byte_offset(array, indices...));
}}
}}
"""
codegen.cpu_module_header += ELEMENT


def _is_ours(function: Callable[..., Any], device: str, options: Mapping[str, Any]) -> bool:
    """Return whether a function is of this package, for a CPU and without derivatives."""
    return device == "cpu" and str(function.__module__).startswith("coopenv.") and not options["enable_backward"]


def _as_in_c(source: str, function: Callable[..., Any], device: str, options: Mapping[str, Any]) -> str:
    """Return the source of a function of this package with indices and loops of C: a sixth less time.

    Warp looks at every index whether it is negative and counts from the end, and at every turn of a loop which way it
    goes. Here no index of an array is negative, and loops count up. No kernel writes to a record of arrays: its strides
    need not be read again after every write to an array (`__restrict__`). Debug builds (`wp.config.mode`) check
    indices, and stay as they are; so does CUDA, where more values would be spilled (`make cuda-check`).
    """
    if not _is_ours(function, device, options) or wp.config.mode == "debug":
        return source
    source = re.sub(r"wp::array_store\((.*), (\w+)\);", r"coopenv::element(\1) = \2;", source)
    source = source.replace("wp::address(", "&coopenv::element(").replace("wp::index(", "coopenv::element(")
    source = re.sub(r"iter_cmp\((\w+)\) == 0", r"\1.i >= \1.end", source)
    head, brace, body = source.partition("\n{")
    return re.sub(r"(\w+\*) (var_\w+)", r"\1 __restrict__ \2", head) + brace + body


def _check_kept(source: str, function: Callable[..., Any], record: str) -> None:
    """Raise a TypeError if a function writes to a field of a record that it has by reference, which is its caller's."""
    if re.search(rf"^ *var_{record}\.\w+ = ", source, re.M):
        raise TypeError(f"{function.__name__}: writes to a field of '{record}', a record of arrays; write to a copy")


_generate_function: Any = codegen.codegen_func


def _function_source(adj: Any, *arguments: Any, **given: Any) -> str:
    """Return the source of a function of this package: on the CPU as in C, with records of arrays by reference.

    Derivatives that nothing differentiates are left out, and `outlined` functions are not inlined.
    """
    options, device = given["options"], given["device"]
    if not _is_ours(adj.func, device, options):
        return str(_generate_function(adj, *arguments, **given))
    if given.get("reverse_only"):
        return ""
    source = _as_in_c(_generate_function(adj, *arguments, **given), adj.func, device, options)
    for arg in adj.args:
        if _has_arrays(arg.type):
            _check_kept(source, adj.func, arg.label)
            source = source.replace(f"    {arg.ctype()} var_{arg.label}", f"    {arg.ctype()}& var_{arg.label}", 1)
    if getattr(adj.func, "outlined", False) and "WP_NOINLINE" not in source:
        source = source.replace("\nstatic ", "\nstatic WP_NOINLINE ", 1)
    return source


codegen.codegen_func = _function_source

_generate: Any = codegen.codegen_kernel


def _kernel_source(kernel: Any, device: str, options: Mapping[str, Any]) -> str:
    """Return the source of a kernel of this package, which reads records of arrays in place.

    Warp copies them for every thread, some kilobytes. No kernel writes to one. On CUDA a parameter whose address is
    taken is copied into local memory, too, unless it is a `__grid_constant__`.
    Source: CUDA C++ Programming Guide, `__grid_constant__`.
    """
    if device == "cuda" and getattr(kernel.func, "host_only", False):
        return ""
    source = _as_in_c(_generate(kernel, device, options), kernel.func, device, options | kernel.options)
    if options["enable_backward"] or not kernel.module.name.startswith("coopenv."):
        return source
    records = [(arg.ctype(), f"var_{arg.label}") for arg in kernel.adj.args if _has_arrays(arg.type)]
    if device == "cpu":
        for kind, name in records:
            _check_kept(source, kernel.func, name.removeprefix("var_"))
            source = source.replace(f"{kind} {name} = _wp_args->", f"{kind}& {name} = _wp_args->")
        return source
    head, brace, body = source.partition("\n{\n")
    for kind, name in records:
        head = head.replace(f"{kind} {name}", f"const __grid_constant__ {kind} constant_{name}")
        body = f"    {kind}& {name} = const_cast<{kind}&>(constant_{name});\n{body}"
    return head + brace + body


codegen.codegen_kernel = _kernel_source


@cache
def lanes_guest() -> Any:
    """Return the guest that lets kernels of a CPU take several worlds at once; None: there is none."""
    point = own("coopenv.lanes").get("cpu")
    return None if point is None else loaded(point, "lanes")


_DERIVATIVES = re.compile(r"^(?:static )?CUDA_CALLABLE (?:void adj_\w+|\w+ add)\([^{}]*?\)\n\{\n.*?^\}\n", re.M | re.S)
_BODY = re.compile(r"\n\{\n.*?\n\}\n", re.S)
_VARIABLE = re.compile(r"\bvar_\w+")
_LOAD = re.compile(r"^ *(var_\w+) = wp::load\((var_\w+)\);\n", re.M)


def _in_place(source: str, records: Sequence[str]) -> str:
    """Return a source that reads records of arrays and arrays in place.

    Warp copies a record before it hands it to a function, and the descriptor of an array before it reads an element.
    The compiler removes most of these copies, which takes a fifth of its time.
    """
    declaration = re.compile(rf"^    (?:{'|'.join([*records, 'wp::array_t<.*>'])}) (var_\w+);\n", re.M)

    def rewritten(body: re.Match[str]) -> str:
        text = body[0]
        copies = set(declaration.findall(text))
        place = {copy: f"(*{of})" for copy, of in _LOAD.findall(text) if copy in copies}
        for line in (declaration, _LOAD):
            text = line.sub(lambda found: "" if found[1] in place else found[0], text)
        return _VARIABLE.sub(lambda found: place.get(found[0], found[0]), text)

    return _BODY.sub(rewritten, source)


_generate_module: Any = context.ModuleBuilder.codegen


def _module_source(builder: Any, device: str) -> str:
    """Return the source of a module; one with the option `in_lanes` takes several worlds at once on the CPU.

    Derivatives of records, which no function uses, would be compiled. Warp compiles a kernel of a CPU twice, once for
    arrays without gaps: here the other version serves all arrays.
    """
    source: str = _generate_module(builder, device)
    ours = device == "cpu" and builder.module.name.startswith("coopenv.")
    if not ours or builder.options["enable_backward"] or wp.config.mode == "debug":
        return source
    if wanted := builder.options.get("in_lanes"):
        source = lanes_guest().in_lanes(source, wanted)
    records = [record.native_name for record in builder.structs if _has_arrays(record)]
    source = _in_place(_DERIVATIVES.sub("", source), records)
    return source.replace("_cpu_forward_tasks<true>(", "_cpu_forward_tasks<false>(")


context.ModuleBuilder.codegen = _module_source  # type: ignore[method-assign]


def host_only(function: Callable[..., Any]) -> Callable[..., Any]:
    """Leave the kernel of a function out of the modules of CUDA devices."""
    function.host_only = True  # type: ignore[attr-defined]
    return function


def device_function(function: Callable[..., Any]) -> Any:
    """Return the Warp function of a Python function, with structs of arrays by reference.

    Such a struct has some kilobytes, as every array has a descriptor. Warp hands functions copies of their arguments,
    which the compiler removes from small functions alone; in an observer of many functions the copies take a fifth of
    the time. Warp's references (`wp.ref`) need a type that is written down. Here types follow from the kernel, so that
    each overload gets its references when it is made.

    Meant for functions that are large or call large ones. Not for differentiated functions: Warp has no derivatives of
    references.
    """
    made = wp.func(function)
    made.__class__ = _ByReference
    return made


def outlined(function: Callable[..., Any]) -> Any:
    """Return a `device_function` that the compiler of a CPU does not inline.

    For stages of a tick and large functions with several callers, which are then compiled once: a sixth of the time of
    the first step. Functions that return matrices or run for every pair of agents would be slower.
    """
    function.outlined = True  # type: ignore[attr-defined]
    return device_function(function)


def subroutine(function: Callable[..., Any]) -> Any:
    """Return a `device_function` that is never inlined.

    For large functions with several callers: ptxas takes minutes for code that contains them several times. They should
    return no matrices, which a call passes through memory.
    """
    made = device_function(function)
    made.inline_hint = "noinline"
    return made


def overload_of(function: Any, subroutine: bool = False) -> Callable[[Callable[..., Any]], Any]:
    """Make another Warp function an overload of a `device_function`: Warp chooses by the types of the arguments.

    At least one argument of both is generic (`Any`). `subroutine`: it is never inlined.
    """

    def add(other: Callable[..., Any]) -> Any:
        made = device_function(other)
        made.inline_hint = "noinline" if subroutine else None
        function.add_overload(made)
        return made

    return add


def struct_of(record: Any) -> Any:
    """Return the `wp.struct` of an instance."""
    return record._cls


def field_types(record: Any) -> dict[str, Any]:
    """Return the types of the fields of a `wp.struct` or an instance of one, by name."""
    return {name: field.type for name, field in getattr(record, "_cls", record).vars.items()}


def scalar_of(kind: Any) -> Any:
    """Return the scalar type of a vector or matrix type; a scalar type is returned unchanged."""
    return getattr(kind, "_wp_scalar_type_", kind)
