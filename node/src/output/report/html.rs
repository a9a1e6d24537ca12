//! Text for HTML: escaping and the way numbers are shown.

/// Text with the characters that mean something in HTML replaced, for element content and quoted attributes.
pub(super) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            // Control characters have no place in HTML.
            c if c.is_control() && c != '\n' && c != '\t' => out.push('\u{FFFD}'),
            c => out.push(c),
        }
    }
    out
}

/// A file name as a relative address: everything but unreserved characters and `/` percent-encoded.
pub(super) fn relative_address(name: &str) -> String {
    let mut out = String::from("./");
    for b in name.bytes() {
        match b {
            b'A'..=b'Z' | b'a'..=b'z' | b'0'..=b'9' | b'-' | b'.' | b'_' | b'~' | b'/' => out.push(char::from(b)),
            _ => out.push_str(&format!("%{b:02X}")),
        }
    }
    out
}

/// A number with about four significant digits; a dash when it is not finite.
pub(super) fn number(value: f64) -> String {
    let size = value.abs();
    if !value.is_finite() {
        "–".into()
    } else if size >= 1000.0 {
        format!("{value:.0}")
    } else if size >= 100.0 {
        format!("{value:.1}")
    } else if size >= 1.0 {
        format!("{value:.2}")
    } else if size >= 0.001 || size == 0.0 {
        format!("{value:.4}")
    } else {
        format!("{value:.1e}")
    }
}

/// Milliseconds as `0.42 ms`, `12 ms` or `1.25 s`.
pub(super) fn duration(ms: f64) -> String {
    if !ms.is_finite() {
        "–".into()
    } else if ms >= 1000.0 {
        format!("{:.2} s", ms / 1000.0)
    } else if ms >= 10.0 {
        format!("{ms:.0} ms")
    } else {
        format!("{ms:.2} ms")
    }
}

/// A size as `512 B`, `1.5 kB`, `12.3 MB`.
pub(super) fn file_size(bytes: u64) -> String {
    let size = bytes as f64;
    match bytes {
        0..1_000 => format!("{bytes} B"),
        1_000..1_000_000 => format!("{:.1} kB", size / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", size / 1e6),
        _ => format!("{:.2} GB", size / 1e9),
    }
}

/// Hours, minutes and seconds of the UTC day, to the millisecond: what tells steps apart at a glance.
pub(super) fn time_of_day(stamp_ns: i64) -> String {
    let ms = stamp_ns.div_euclid(1_000_000).rem_euclid(86_400_000);
    format!("{:02}:{:02}:{:02}.{:03}", ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60, ms % 1000)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_breaks_out_of_the_text() {
        assert_eq!(escape("<b a=\"'&\u{0}\">"), "&lt;b a=&quot;&#39;&amp;\u{FFFD}&quot;&gt;");
        assert_eq!(relative_address("a b/ü?.ply"), "./a%20b/%C3%BC%3F.ply");
        assert_eq!(relative_address("javascript:x"), "./javascript%3Ax");
    }

    #[test]
    fn numbers_are_short() {
        assert_eq!([1234.5, 123.45, 12.345, 0.5, 0.0, 1e-5, f64::NAN].map(number).join(" "), {
            "1234 123.5 12.35 0.5000 0.0000 1.0e-5 –"
        });
        assert_eq!([0.424, 12.4, 1250.0].map(duration).join(" "), "0.42 ms 12 ms 1.25 s");
        assert_eq!([999, 1500, 12_300_000, 5_000_000_000].map(file_size).join(" "), "999 B 1.5 kB 12.3 MB 5.00 GB");
        assert_eq!(time_of_day(1_700_000_000_123_000_000), "22:13:20.123");
        assert_eq!(time_of_day(-1), "23:59:59.999");
    }
}
