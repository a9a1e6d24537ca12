//! The stack machine: one operation after the other, each making at most one value.

use std::collections::HashMap;

use super::classes::{Kind, kind};
use super::{Id, Node, PickleError};

/// Runs a whole pickle and returns its values and the outermost one.
pub(super) fn run(bytes: &[u8]) -> Result<(Vec<Node>, Id), PickleError> {
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
    Ok((machine.nodes, root))
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
        match self.stack.pop() {
            Some(id) if self.stack.len() >= floor => Ok(id),
            _ => self.fail("the stack is empty"),
        }
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
        if !ids.len().is_multiple_of(2) {
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
