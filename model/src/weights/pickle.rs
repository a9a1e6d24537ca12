//! A reader for the pickles inside PyTorch checkpoints that only ever builds plain data.
//!
//! Pickle is a program for a stack machine, and Python's own reader calls whatever functions the program names. This one
//! has no functions to call: the few constructors a checkpoint needs are recognised by name and turned into data, others
//! make the file refused. Values live in an arena and refer to each other by index, so shared and cyclic structures cost
//! nothing and no operation allocates more than the bytes it consumed.

use std::collections::HashMap;

/// Index of a value in the arena.
pub(super) type Id = usize;

/// A value.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Node {
    None,
    Bool(bool),
    Int(i64),
    Float(f64),
    Str(String),
    Bytes,
    Tuple(Vec<Id>),
    List(Vec<Id>),
    Dict(Vec<(Id, Id)>),
    Class(String, String),
    /// A storage reference: the tuple PyTorch writes for it.
    Storage(Id),
    /// `_rebuild_tensor_v2`'s arguments.
    Tensor(Id),
    /// An object whose content does not matter here.
    Inert,
}

/// Why a pickle is refused: byte offset and reason.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PickleError {
    pub at: usize,
    pub reason: String,
}

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

enum Kind {
    Inert,
    Dict,
    Tensor,
    Parameter,
    /// May be named (a storage type, a dtype) but not called.
    NameOnly,
}

fn kind(module: &str, name: &str) -> Option<Kind> {
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

/// A read pickle.
#[derive(Debug)]
pub(super) struct Pickle {
    nodes: Vec<Node>,
    root: Id,
}

impl Pickle {
    /// Reads a whole pickle, protocols 2 to 5.
    pub fn read(bytes: &[u8]) -> Result<Self, PickleError> {
        let mut machine = Machine {
            bytes,
            at: 0,
            op_at: 0,
            nodes: Vec::new(),
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
        };
        let root = machine.run()?;
        Ok(Self { nodes: machine.nodes, root })
    }

    /// The outermost value.
    pub fn root(&self) -> Id {
        self.root
    }

    /// A value; ids come from this pickle, a foreign one reads as `None`.
    pub fn node(&self, id: Id) -> &Node {
        self.nodes.get(id).unwrap_or(&Node::None)
    }

    /// The value of a string key in a dictionary, the last one if it appears twice.
    pub fn item(&self, dict: Id, key: &str) -> Option<Id> {
        let Node::Dict(items) = self.node(dict) else { return None };
        let found = items.iter().rev().find(|(k, _)| matches!(self.node(*k), Node::Str(s) if s == key));
        found.map(|(_, value)| *value)
    }
}

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    /// Start of the operation being run, for messages.
    op_at: usize,
    nodes: Vec<Node>,
    stack: Vec<Id>,
    /// Stack heights.
    marks: Vec<usize>,
    memo: HashMap<u32, Id>,
}

type Step<T> = Result<T, PickleError>;

impl<'a> Machine<'a> {
    fn fail<T>(&self, reason: impl Into<String>) -> Step<T> {
        Err(PickleError { at: self.op_at, reason: reason.into() })
    }

    fn take(&mut self, count: usize) -> Step<&'a [u8]> {
        let taken = self.at.checked_add(count).and_then(|end| self.bytes.get(self.at..end));
        match taken {
            Some(bytes) => {
                self.at += count;
                Ok(bytes)
            }
            None => self.fail("the pickle ends inside a value"),
        }
    }

    /// Little-endian unsigned number of `count` (at most 8) bytes.
    fn number(&mut self, count: usize) -> Step<u64> {
        Ok(self.take(count)?.iter().rev().fold(0, |n, &b| n << 8 | u64::from(b)))
    }

    fn size(&mut self, count: usize) -> Step<usize> {
        let n = self.number(count)?;
        usize::try_from(n).or_else(|_| self.fail("a length does not fit this machine"))
    }

    fn text(&mut self, count: usize) -> Step<String> {
        let bytes = self.take(count)?.to_vec();
        String::from_utf8(bytes).or_else(|_| self.fail("a string is not UTF-8"))
    }

    fn line(&mut self) -> Step<String> {
        let rest = self.bytes.get(self.at..).unwrap_or_default();
        match rest.iter().position(|&b| b == b'\n') {
            Some(length) => {
                let line = self.text(length)?;
                self.at += 1;
                Ok(line)
            }
            None => self.fail("a line does not end"),
        }
    }

    fn push(&mut self, node: Node) -> Step<()> {
        self.nodes.push(node);
        self.stack.push(self.nodes.len() - 1);
        Ok(())
    }

    fn pop(&mut self) -> Step<Id> {
        let floor = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() > floor {
            if let Some(id) = self.stack.pop() {
                return Ok(id);
            }
        }
        self.fail("the stack is empty")
    }

    fn pop_mark(&mut self) -> Step<Vec<Id>> {
        match self.marks.pop() {
            Some(height) if height <= self.stack.len() => Ok(self.stack.split_off(height)),
            _ => self.fail("no mark on the stack"),
        }
    }

    fn pop_tuple(&mut self, count: usize) -> Step<()> {
        let mut ids = (0..count).map(|_| self.pop()).collect::<Step<Vec<_>>>()?;
        ids.reverse();
        self.push(Node::Tuple(ids))
    }

    fn top(&mut self) -> Step<&mut Node> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(&id) if self.stack.len() > floor && id < self.nodes.len() => Ok(&mut self.nodes[id]),
            _ => self.fail("the stack is empty"),
        }
    }

    fn memoize(&mut self, key: u32) -> Step<()> {
        let floor = self.marks.last().copied().unwrap_or(0);
        match self.stack.last() {
            Some(&id) if self.stack.len() > floor => {
                self.memo.insert(key, id);
                Ok(())
            }
            _ => self.fail("nothing to remember"),
        }
    }

    fn recall(&mut self, key: u32) -> Step<()> {
        match self.memo.get(&key) {
            Some(&id) => {
                self.stack.push(id);
                Ok(())
            }
            None => self.fail(format!("nothing was remembered under {key}")),
        }
    }

    fn class(&mut self, module: String, name: String) -> Step<()> {
        if kind(&module, &name).is_some() {
            return self.push(Node::Class(module, name));
        }
        self.fail(format!(
            "it names '{module}.{name}', which is not plain data and is not run; save only the state dict"
        ))
    }

    fn append(&mut self, ids: Vec<Id>) -> Step<()> {
        match self.top()? {
            Node::List(list) => list.extend(ids),
            Node::Inert => {}
            _ => return self.fail("items are appended to something that is no list"),
        }
        Ok(())
    }

    fn set_items(&mut self, ids: Vec<Id>) -> Step<()> {
        if ids.len() % 2 != 0 {
            return self.fail("a key without a value");
        }
        match self.top()? {
            Node::Dict(items) => items.extend(ids.chunks_exact(2).map(|pair| (pair[0], pair[1]))),
            Node::Inert => {}
            _ => return self.fail("items are set in something that is no dictionary"),
        }
        Ok(())
    }

    /// Stands for calling a class with arguments: the result is data, nothing runs.
    fn construct(&mut self) -> Step<()> {
        let args = self.pop()?;
        let class = self.pop()?;
        let Some(Node::Class(module, name)) = self.nodes.get(class).cloned() else {
            return self.fail("something that is no class is called");
        };
        match kind(&module, &name) {
            Some(Kind::Inert) => self.push(Node::Inert),
            Some(Kind::Dict) => self.push(Node::Dict(Vec::new())),
            Some(Kind::Tensor) => self.push(Node::Tensor(args)),
            Some(Kind::Parameter) => match self.nodes.get(args) {
                Some(Node::Tuple(parts)) if !parts.is_empty() => {
                    self.stack.push(parts[0]);
                    Ok(())
                }
                _ => self.fail("a parameter without a tensor"),
            },
            Some(Kind::NameOnly) | None => self.fail(format!("'{module}.{name}' is called; only data is read")),
        }
    }

    fn run(&mut self) -> Step<Id> {
        loop {
            self.op_at = self.at;
            let op = self.take(1)?[0];
            match op {
                0x80 => match self.number(1)? {
                    2..=5 => {}
                    other => return self.fail(format!("protocol {other}; 2 to 5 are read")),
                },
                0x95 => drop(self.take(8)?),
                b'.' => return self.pop(),
                b'(' => self.marks.push(self.stack.len()),
                b'0' => drop(self.pop()?),
                b'1' => drop(self.pop_mark()?),
                b'2' => {
                    let id = self.pop()?;
                    self.stack.extend([id, id]);
                }
                b'N' => self.push(Node::None)?,
                0x88 => self.push(Node::Bool(true))?,
                0x89 => self.push(Node::Bool(false))?,
                b'J' => {
                    let n = self.number(4)? as u32 as i32;
                    self.push(Node::Int(i64::from(n)))?;
                }
                b'K' => {
                    let n = self.number(1)? as i64;
                    self.push(Node::Int(n))?;
                }
                b'M' => {
                    let n = self.number(2)? as i64;
                    self.push(Node::Int(n))?;
                }
                0x8a => {
                    let count = self.size(1)?;
                    self.long(count)?;
                }
                0x8b => {
                    let count = self.size(4)?;
                    self.long(count)?;
                }
                b'G' => {
                    let bits = self.take(8)?.iter().fold(0u64, |n, &b| n << 8 | u64::from(b));
                    self.push(Node::Float(f64::from_bits(bits)))?;
                }
                b'X' | 0x8c | 0x8d => {
                    let width = match op {
                        b'X' => 4,
                        0x8c => 1,
                        _ => 8,
                    };
                    let count = self.size(width)?;
                    let text = self.text(count)?;
                    self.push(Node::Str(text))?;
                }
                b'B' | b'T' | b'C' | b'U' | 0x8e | 0x96 => {
                    let width = match op {
                        b'B' | b'T' => 4,
                        b'C' | b'U' => 1,
                        _ => 8,
                    };
                    let count = self.size(width)?;
                    self.take(count)?;
                    self.push(Node::Bytes)?;
                }
                b')' => self.push(Node::Tuple(Vec::new()))?,
                b't' => {
                    let ids = self.pop_mark()?;
                    self.push(Node::Tuple(ids))?;
                }
                0x85..=0x87 => self.pop_tuple(usize::from(op - 0x84))?,
                b']' => self.push(Node::List(Vec::new()))?,
                b'l' => {
                    let ids = self.pop_mark()?;
                    self.push(Node::List(ids))?;
                }
                b'a' => {
                    let id = self.pop()?;
                    self.append(vec![id])?;
                }
                b'e' => {
                    let ids = self.pop_mark()?;
                    self.append(ids)?;
                }
                b'}' => self.push(Node::Dict(Vec::new()))?,
                b'd' => {
                    let ids = self.pop_mark()?;
                    self.push(Node::Dict(Vec::new()))?;
                    self.set_items(ids)?;
                }
                b's' => {
                    let value = self.pop()?;
                    let key = self.pop()?;
                    self.set_items(vec![key, value])?;
                }
                b'u' => {
                    let ids = self.pop_mark()?;
                    self.set_items(ids)?;
                }
                0x8f => self.push(Node::Inert)?,
                0x90 => {
                    let ids = self.pop_mark()?;
                    self.append(ids)?;
                }
                0x91 => {
                    self.pop_mark()?;
                    self.push(Node::Inert)?;
                }
                b'q' | b'r' => {
                    let key = self.number(if op == b'q' { 1 } else { 4 })? as u32;
                    self.memoize(key)?;
                }
                0x94 => {
                    let key = self.memo.len() as u32;
                    self.memoize(key)?;
                }
                b'h' | b'j' => {
                    let key = self.number(if op == b'h' { 1 } else { 4 })? as u32;
                    self.recall(key)?;
                }
                b'c' => {
                    let module = self.line()?;
                    let name = self.line()?;
                    self.class(module, name)?;
                }
                0x93 => {
                    let (name, module) = (self.pop()?, self.pop()?);
                    match (&self.nodes[module], &self.nodes[name]) {
                        (Node::Str(module), Node::Str(name)) => self.class(module.clone(), name.clone())?,
                        _ => return self.fail("a class name is no string"),
                    }
                }
                b'R' | 0x81 => self.construct()?,
                b'b' => {
                    // Attributes of an object: none matters here.
                    self.pop()?;
                    self.top()?;
                }
                b'Q' => {
                    let id = self.pop()?;
                    self.push(Node::Storage(id))?;
                }
                other => return self.fail(format!("operation 0x{other:02x} has no place in a checkpoint")),
            }
        }
    }

    /// A little-endian two's complement number; past 8 bytes it cannot be a size and becomes inert.
    fn long(&mut self, count: usize) -> Step<()> {
        let bytes = self.take(count)?;
        if bytes.len() > 8 {
            return self.push(Node::Inert);
        }
        let negative = bytes.last().is_some_and(|b| b & 0x80 != 0);
        let mut all = [if negative { 0xff } else { 0 }; 8];
        all[..bytes.len()].copy_from_slice(bytes);
        self.push(Node::Int(i64::from_le_bytes(all)))
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_call_of_anything_else_is_refused_by_name() {
        for program in
            [&b"\x80\x02cos\nsystem\nX\x02\x00\x00\x00ls\x85R."[..], b"\x80\x04\x8c\x02os\x8c\x06system\x93."]
        {
            let error = Pickle::read(program).unwrap_err();
            assert!(error.reason.contains("os.system"), "{error:?}");
        }
        for name in ["eval", "exec", "getattr", "__import__", "open"] {
            let program = format!("\x02cbuiltins\n{name}\n)R.");
            let program = [&[0x80], program.as_bytes()].concat();
            assert!(Pickle::read(&program).unwrap_err().reason.contains(name));
        }
        // A storage class may be named, not called.
        assert!(Pickle::read(b"\x80\x02ctorch\nFloatStorage\n.").is_ok());
        assert!(Pickle::read(b"\x80\x02ctorch\nFloatStorage\n)R.").is_err());
    }

    #[test]
    fn numbers_strings_and_sharing() {
        // {"a": (1, -2, 2.5, True), "b": the same tuple}
        let mut program = b"\x80\x02}(X\x01\x00\x00\x00a(K\x01J\xfe\xff\xff\xffG".to_vec();
        program.extend(2.5f64.to_be_bytes());
        program.extend(b"\x88tq\x05X\x01\x00\x00\x00bh\x05u.");
        let pickle = Pickle::read(&program).unwrap();
        let a = pickle.item(pickle.root(), "a").unwrap();
        assert_eq!(pickle.item(pickle.root(), "b"), Some(a));
        let Node::Tuple(ids) = pickle.node(a) else { panic!("no tuple") };
        let values: Vec<&Node> = ids.iter().map(|&id| pickle.node(id)).collect();
        assert_eq!(values, [&Node::Int(1), &Node::Int(-2), &Node::Float(2.5), &Node::Bool(true)]);
        let long = Pickle::read(b"\x80\x02\x8a\x02\x00\x80.").unwrap();
        assert_eq!(long.node(long.root()), &Node::Int(-32768));
    }

    #[test]
    fn claimed_lengths_do_not_allocate() {
        for program in
            [&b"\x80\x04\x8d\xff\xff\xff\xff\xff\xff\xff\x7f"[..], b"\x80\x02X\xff\xff\xff\xffab", b"\x80\x02."]
        {
            assert!(Pickle::read(program).is_err());
        }
    }

    proptest! {
        #[test]
        fn random_programs_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..200)) {
            let _ = Pickle::read(&bytes);
        }

        #[test]
        fn random_operations_never_panic(ops in prop::collection::vec(
            prop::sample::select(&b"\x80\x02(0124NKh)]}talesud.qbQR\x81\x85\x86\x87\x93\x94\x8f\x90\x91"[..]), 0..120))
        {
            let _ = Pickle::read(&ops);
        }
    }
}
