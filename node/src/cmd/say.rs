//! Words for the terminal. The standard macros panic where nothing can be written: a log on a full disk, a reader of the pipe that
//! has gone. A run of hours is not to end for that, so here what cannot be said is left unsaid.

/// A line on the standard output.
macro_rules! say {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stdout(), $($text)*);
    }};
}

/// Text on the standard output as it is.
macro_rules! say_text {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = write!(std::io::stdout(), $($text)*);
    }};
}

/// A line on the standard error.
macro_rules! complain {
    ($($text:tt)*) => {{
        use std::io::Write as _;
        let _ = writeln!(std::io::stderr(), $($text)*);
    }};
}
