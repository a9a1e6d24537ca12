//! An error and its causes in one line, each said once.

/// The error's text and its causes', joined by colons; a cause that its error's text holds already is left out.
pub fn error_line(e: &anyhow::Error) -> String {
    let mut line = String::new();
    for cause in e.chain() {
        let text = cause.to_string();
        if !line.contains(&text) {
            if !line.is_empty() {
                line += ": ";
            }
            line += &text;
        }
    }
    line
}

#[cfg(test)]
mod tests {
    use anyhow::Context;

    use super::*;

    #[test]
    fn a_cause_is_said_once() {
        #[derive(Debug, thiserror::Error)]
        #[error("{path}: {source}")]
        struct Inner {
            path: &'static str,
            source: std::io::Error,
        }
        let inner = || Inner { path: "a.yaml", source: std::io::Error::other("disk on fire") };
        assert_eq!(error_line(&inner().into()), "a.yaml: disk on fire");
        let e = Err::<(), _>(inner()).context("cannot read bag").unwrap_err();
        assert_eq!(error_line(&e), "cannot read bag: a.yaml: disk on fire");
        assert_eq!(format!("{e:#}"), "cannot read bag: a.yaml: disk on fire: disk on fire");
    }
}
