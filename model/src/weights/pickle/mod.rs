//! A reader for the pickles inside PyTorch checkpoints that only ever builds plain data.
//!
//! Pickle is a program for a stack machine, and Python's own reader calls whatever functions the program names. This one
//! has no functions to call: the few constructors a checkpoint needs are recognised by name and turned into data, others
//! make the file refused. Values live in an arena and refer to each other by index, so shared and cyclic structures cost
//! nothing and no operation allocates more than the bytes it consumed.

mod classes;
mod machine;

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

/// A read pickle.
#[derive(Debug)]
pub(super) struct Pickle {
    nodes: Vec<Node>,
    root: Id,
}

impl Pickle {
    /// Reads a whole pickle, protocols 2 to 5.
    pub fn read(bytes: &[u8]) -> Result<Self, PickleError> {
        let (nodes, root) = machine::run(bytes)?;
        Ok(Self { nodes, root })
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
