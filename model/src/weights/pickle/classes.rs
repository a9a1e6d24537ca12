//! Which classes and functions a checkpoint may name, and what data they stand for.

/// Classes and functions whose results are data; `module.name`, the module as Python 2 and 3 spell it.
const INERT: [&str; 27] = [
    "argparse.Namespace",
    "builtins.set",
    "builtins.frozenset",
    "builtins.list",
    "builtins.tuple",
    "builtins.slice",
    "builtins.complex",
    "builtins.bytearray",
    "builtins.int",
    "builtins.float",
    "builtins.bool",
    "builtins.str",
    "builtins.object",
    "_codecs.encode",
    "collections.deque",
    "collections.Counter",
    "datetime.datetime",
    "datetime.timedelta",
    "pathlib.PosixPath",
    "pathlib.PurePosixPath",
    "pathlib.WindowsPath",
    "pathlib.PureWindowsPath",
    "numpy.dtype",
    "numpy.core.multiarray.scalar",
    "numpy._core.multiarray.scalar",
    "torch.Size",
    "torch.device",
];

/// Names that mean a dictionary.
const DICTS: [&str; 3] = ["collections.OrderedDict", "collections.defaultdict", "builtins.dict"];

/// Functions that build tensors, and wrappers that add nothing to the tensor they are given.
const TENSOR: &str = "torch._utils._rebuild_tensor_v2";
const PARAMETERS: [&str; 2] = ["torch._utils._rebuild_parameter", "torch._utils._rebuild_parameter_with_state"];

/// What naming or calling something gives.
pub(super) enum Kind {
    Inert,
    Dict,
    Tensor,
    Parameter,
    /// May be named (a storage type, a dtype) but not called.
    NameOnly,
}

/// What a name stands for; none for everything that is not plain data.
pub(super) fn kind(module: &str, name: &str) -> Option<Kind> {
    let module = if module == "__builtin__" { "builtins" } else { module };
    let full = format!("{module}.{name}");
    let plain_name = name.chars().all(|c| c.is_ascii_alphanumeric() || c == '_');
    if full == TENSOR {
        Some(Kind::Tensor)
    } else if PARAMETERS.contains(&full.as_str()) {
        Some(Kind::Parameter)
    } else if DICTS.contains(&full.as_str()) {
        Some(Kind::Dict)
    } else if INERT.contains(&full.as_str()) {
        Some(Kind::Inert)
    } else if (module == "torch" || module == "torch.storage") && plain_name && is_torch_name(name) {
        Some(Kind::NameOnly)
    } else {
        None
    }
}

fn is_torch_name(name: &str) -> bool {
    name.ends_with("Storage")
        || ["float", "half", "bfloat", "double", "int", "uint", "bool", "complex", "long", "short"]
            .iter()
            .any(|p| name.strip_prefix(p).is_some_and(|rest| rest.chars().all(|c| c.is_ascii_digit())))
}
