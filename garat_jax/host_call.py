"""Python functions within compiled programs that JAX's compilation cache can keep.

`jax.pure_callback` ties a program to an object of this process, so JAX never writes such a program
to its cache. Here a program holds the function's name instead. XLA hands the call to one handler,
through its C interface for foreign functions, and the handler looks the name up among the functions
that this process traced. The handler is made with ctypes: nothing has to be compiled.

The call is declared to have a side effect, though it has none. XLA runs programs on threads of its
own, and one that is still under way when the interpreter ends would enter Python through the
handler: such processes crashed or hung. JAX keeps a token of each program with an effect, and at
exit it waits for them before anything is torn down.

The structures below are those of xla/ffi/api/c_api.h, which comes with jaxlib, as of version 0.1 of
that interface. Where XLA does not take the handler, and on accelerators, `jax.pure_callback`
serves, and the program is compiled at every start.
"""

import ctypes
import functools
import math
import traceback
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from garat_jax.interrupt import entered_from_c, raise_held

TARGET = "garat_jax_host_call"
INTERFACE = (0, 1)
"""Version of XLA's interface that this is written for; later minor versions take it too."""
METADATA_EXTENSION = 1
INTERNAL_ERROR = 13

HostFunction = Callable[[Sequence[np.ndarray]], np.ndarray]
"""Arrays of 32-bit words, [..., n] each, as many leading axes in all, to words [..., size].

They are C-contiguous, and XLA's: to be read during the call alone."""

_functions: dict[str, HostFunction] = {}
"""What the programs of this process may call, as long as the process lives."""


def call(name: str, function: HostFunction, size: int, inputs: Sequence[jax.Array]) -> jax.Array:
    """Call a pure function on the host from within a compiled program.

    Under `vmap` it is called once for the whole batch; inputs that are not batched have leading
    axes of length 1.

    Args:
        name: Says all that the function does: a program from an earlier process, which was kept
            under this name, calls it too.
        function: What to call. It may not use JAX.
        size: 32-bit words in the result of one call.
        inputs: 32-bit words, [n] each.

    Returns:
        The result's 32-bit words, [size].
    """
    shape = jax.ShapeDtypeStruct((size,), jnp.uint32)
    if jax.default_backend() != "cpu" or not _is_registered():
        return jax.pure_callback(
            lambda *arrays: function([np.ascontiguousarray(array) for array in arrays]),
            shape,
            *inputs,
            vmap_method="expand_dims",
        )
    _functions[name] = function
    called = jax.ffi.ffi_call(TARGET, shape, vmap_method="expand_dims", has_side_effect=True)
    return called(*inputs, function=name)


class _Extension(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("type", ctypes.c_int),
        ("next", ctypes.c_void_p),
    ]


class _Header(ctypes.Structure):
    _fields_ = [
        ("struct_size", ctypes.c_size_t),
        ("extension", ctypes.POINTER(_Extension)),
    ]


class _Version(ctypes.Structure):
    _fields_ = [
        ("header", _Header),
        ("major", ctypes.c_int),
        ("minor", ctypes.c_int),
    ]


class _Metadata(ctypes.Structure):
    _fields_ = [("struct_size", ctypes.c_size_t), ("version", _Version)]


class _MetadataExtension(ctypes.Structure):
    _fields_ = [
        ("extension", _Extension),
        ("metadata", ctypes.POINTER(_Metadata)),
    ]


class _ErrorArguments(ctypes.Structure):
    _fields_ = [
        ("header", _Header),
        ("message", ctypes.c_char_p),
        ("code", ctypes.c_int),
    ]


_ErrorCreate = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_ErrorArguments))


class _Interface(ctypes.Structure):
    _fields_ = [
        ("header", _Header),
        ("version", _Version),
        ("internal", ctypes.c_void_p),
        ("error_create", _ErrorCreate),
    ]


class _Buffer(ctypes.Structure):
    _fields_ = [
        ("header", _Header),
        ("dtype", ctypes.c_int),
        ("data", ctypes.c_void_p),
        ("rank", ctypes.c_int64),
        ("dims", ctypes.POINTER(ctypes.c_int64)),
    ]


class _Buffers(ctypes.Structure):
    _fields_ = [
        ("header", _Header),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(_Buffer))),
    ]


class _Text(ctypes.Structure):
    _fields_ = [("start", ctypes.c_void_p), ("length", ctypes.c_size_t)]


class _Attributes(ctypes.Structure):
    _fields_ = [
        ("header", _Header),
        ("size", ctypes.c_int64),
        ("types", ctypes.c_void_p),
        ("names", ctypes.c_void_p),
        ("items", ctypes.POINTER(ctypes.POINTER(_Text))),
    ]


class _CallFrame(ctypes.Structure):
    _fields_ = [
        ("header", _Header),
        ("interface", ctypes.POINTER(_Interface)),
        ("context", ctypes.c_void_p),
        ("stage", ctypes.c_int),
        ("arguments", _Buffers),
        ("results", _Buffers),
        ("attributes", _Attributes),
    ]


def _array(buffer: _Buffer) -> np.ndarray:
    """Return XLA's buffer of 32-bit words as an array, without a copy."""
    shape = tuple(buffer.dims[: buffer.rank])
    size = math.prod(shape)
    if not size:
        return np.empty(shape, np.uint32)
    memory = (ctypes.c_uint32 * size).from_address(buffer.data)
    return np.frombuffer(memoryview(memory), np.uint32).reshape(shape)


@entered_from_c
def _handle(frame) -> int | None:
    """Serve XLA: say which interface this is for, or call a function; return None or an error."""
    frame = frame.contents
    extension = frame.header.extension
    if extension and extension.contents.type == METADATA_EXTENSION:
        asked = ctypes.cast(extension, ctypes.POINTER(_MetadataExtension)).contents
        version = asked.metadata.contents.version
        version.major, version.minor = INTERFACE
        return None
    try:
        name = frame.attributes.items[0].contents
        function = _functions[ctypes.string_at(name.start, name.length).decode()]
        arguments = frame.arguments
        inputs = [_array(arguments.items[i].contents) for i in range(arguments.size)]
        _array(frame.results.items[0].contents)[...] = function(inputs)
        raise_held()
    except BaseException:  # whatever it is, it cannot pass through C
        error = _ErrorArguments(message=traceback.format_exc().encode(), code=INTERNAL_ERROR)
        error.header.struct_size = ctypes.sizeof(error)
        return frame.interface.contents.error_create(ctypes.byref(error))
    return None


_handler = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.POINTER(_CallFrame))(_handle)


@functools.cache
def _is_registered() -> bool:
    """Give the handler to XLA once, and say whether XLA took it."""
    try:
        capsule = jax.ffi.pycapsule(ctypes.cast(_handler, ctypes.c_void_p))
        jax.ffi.register_ffi_target(TARGET, capsule, platform="cpu")
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(_handler))  # XLA keeps its address to the end
    except jax.errors.JaxRuntimeError:
        return False
    return True
