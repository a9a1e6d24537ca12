//! In what numbers products are taken.

use std::fmt;
use std::str::FromStr;

use crate::error::ModelError;

/// In what numbers the products of a linear layer or of attention are taken. Everything else is f32 in all of them, and so
/// is whatever the kernels do not cover: other devices, other types, and tensors that track gradients.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Precision {
    /// f32 throughout; on tile units products of three bf16 parts, to f32's own rounding.
    #[default]
    F32,
    /// Operands rounded to bf16, sums in f32. On processors with AMX tile units several times as fast as f32; elsewhere
    /// it says what such a machine would give (but for the softmax's weights, which only tile units round) and is no faster.
    Bf16,
    /// Whole numbers with exact 32-bit sums: weights (a scale per output) and inputs (a scale per row) about equally fine,
    /// each in 11 to 15 bits, as many as let no sum overflow.
    Int16,
    /// The same with weights in 8 bits and inputs in up to 15. On the vectors there are kernels for it costs what `Int16`
    /// costs: it shows what storing weights in 8 bits would lose.
    Int8,
}

impl Precision {
    /// All, with the names they are configured by.
    pub const ALL: [(Self, &'static str); 4] =
        [(Self::F32, "f32"), (Self::Bf16, "bf16"), (Self::Int16, "int16"), (Self::Int8, "int8")];
}

impl fmt::Display for Precision {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let name = Self::ALL.iter().find(|(p, _)| p == self).map_or("", |(_, name)| name);
        f.write_str(name)
    }
}

impl FromStr for Precision {
    type Err = ModelError;

    fn from_str(text: &str) -> Result<Self, ModelError> {
        let found = Self::ALL.iter().find(|(_, name)| *name == text);
        found.map(|(precision, _)| *precision).ok_or_else(|| {
            let names = Self::ALL.map(|(_, name)| name).join(", ");
            ModelError::Input(format!("precision '{text}' is not known; use one of {names}"))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_read_back() {
        for (precision, name) in Precision::ALL {
            assert_eq!(name.parse::<Precision>().unwrap(), precision);
            assert_eq!(precision.to_string(), name);
        }
        let error = "int4".parse::<Precision>().unwrap_err().to_string();
        assert!(error.contains("int4") && error.contains("int8"), "{error}");
    }
}
