//! A stage that panics must end neither a night's replay nor a vehicle's node: the panic is caught, what it may have left
//! half done is made anew, and the run goes on and counts it.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};

/// Panics in a row, with no step between them, after which a run ends: what fails every time is not helped by starting it
/// again.
pub const MOST_IN_A_ROW: u32 = 5;

/// A stage that panicked every time.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error(
    "the {stage} stage panicked {times} times in a row, last: {what}; this is a fault of the program, please report it"
)]
pub struct StagePanics {
    /// Which.
    pub stage: &'static str,
    /// How often.
    pub times: u32,
    /// What the last panic said.
    pub what: String,
}

/// Runs `stage`; a panic becomes what it said. The caller makes everything anew that the stage could change.
pub fn caught<T>(stage: impl FnOnce() -> T) -> Result<T, String> {
    // Unwind safety is the caller's promise, in the line above.
    catch_unwind(AssertUnwindSafe(stage)).map_err(|payload| said(&*payload))
}

fn said(payload: &(dyn Any + Send)) -> String {
    let text = payload.downcast_ref::<&str>().copied().or_else(|| payload.downcast_ref::<String>().map(String::as_str));
    text.unwrap_or("(nothing)").to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_panic_said_is_kept() {
        assert_eq!(caught(|| 3), Ok(3));
        assert_eq!(caught(|| -> u8 { panic!("no {}", "luck") }), Err("no luck".into()));
        assert_eq!(caught(|| -> u8 { panic!("fixed") }), Err("fixed".into()));
        assert_eq!(caught(|| -> u8 { std::panic::panic_any(7) }), Err("(nothing)".into()));
    }
}
