//! "Did you mean": the known name nearest to one that is not known.

/// The nearest of `known`, if so near that it may have been meant: a third of the letters may be wrong.
pub(crate) fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let distance = |other: &str| strsim::damerau_levenshtein(name, other);
    let (d, best) = known.into_iter().map(|other| (distance(other), other)).min()?;
    (d <= (name.chars().count() / 3).max(1)).then_some(best)
}

/// That there is no such parameter, with the one that may have been meant.
pub(super) fn no_parameter(name: &str) -> String {
    let docs = super::Config::describe();
    match nearest(name, docs.iter().map(|d| d.name.as_str())) {
        Some(meant) => format!("no parameter {name}; did you mean {meant}?"),
        None => format!("no parameter {name}; `storm config` lists them"),
    }
}

/// What the YAML library says of an unknown field, with the field that may have been meant instead of all there are.
pub(super) fn with_suggestion(message: &str) -> String {
    let parts = || {
        let (before, rest) = message.split_once("unknown field `")?;
        let (field, rest) = rest.split_once('`')?;
        // `expected one of `a`, `b` at line 3 column 5`
        let (fields, place) = rest.rsplit_once('`')?;
        let known = fields.split('`').filter(|part| !part.contains([' ', ',']) && !part.is_empty());
        let meant = nearest(field, known)?;
        Some(format!("{before}unknown key `{field}`{place}; did you mean `{meant}`?"))
    };
    parts().unwrap_or_else(|| message.to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::Config;

    #[test]
    fn near_names_are_offered_and_far_ones_are_not() {
        assert_eq!(no_parameter("window.strid_sec"), "no parameter window.strid_sec; did you mean window.stride_sec?");
        assert!(no_parameter("engine.turbo").contains("storm config"));
        let e = Config::from_yaml("window:\n  strid_sec: 0.4\n").unwrap_err().to_string();
        assert!(e.contains("did you mean `stride_sec`?") && e.contains("line 2") && !e.contains("timesteps"), "{e}");
        let e = Config::from_yaml("windov: {}\n").unwrap_err().to_string();
        assert!(e.contains("did you mean `window`?"), "{e}");
        let e = Config::from_yaml("window: {warp_factor: 9}\n").unwrap_err().to_string();
        assert!(e.contains("warp_factor") && e.contains("stride_sec"), "{e}");
    }
}
