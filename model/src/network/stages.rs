//! Intermediate tensors by name, for comparing with other implementations; costs nothing when nothing is asked for.

use std::collections::BTreeMap;

use candle_core::Tensor;

/// Which intermediate tensors to keep, and the kept ones.
#[derive(Debug, Default)]
pub struct Stages {
    wanted: Wanted,
    tensors: BTreeMap<String, Tensor>,
}

#[derive(Debug, Default)]
enum Wanted {
    #[default]
    Nothing,
    Everything,
    These(Vec<String>),
}

impl Stages {
    /// Keeps nothing.
    pub fn none() -> Self {
        Self::default()
    }

    /// Keeps every stage: more memory than the forward pass itself.
    pub fn all() -> Self {
        Self { wanted: Wanted::Everything, tensors: BTreeMap::new() }
    }

    /// Keeps the named stages.
    pub fn only(names: &[&str]) -> Self {
        Self { wanted: Wanted::These(names.iter().map(|&n| n.to_owned()).collect()), tensors: BTreeMap::new() }
    }

    /// A kept tensor.
    pub fn get(&self, name: &str) -> Option<&Tensor> {
        self.tensors.get(name)
    }

    /// Names of the kept tensors.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.tensors.keys().map(String::as_str)
    }

    /// Whether any stage is to be kept.
    pub(crate) fn asked(&self) -> bool {
        !matches!(self.wanted, Wanted::Nothing)
    }

    pub(crate) fn wants(&self, name: &str) -> bool {
        match &self.wanted {
            Wanted::Nothing => false,
            Wanted::Everything => true,
            Wanted::These(names) => names.iter().any(|n| n == name),
        }
    }

    pub(crate) fn keep(&mut self, name: &str, tensor: &Tensor) {
        if self.wants(name) {
            self.tensors.insert(name.to_owned(), tensor.clone());
        }
    }
}
