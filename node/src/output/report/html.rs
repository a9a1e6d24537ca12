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

/// Date and time of a stamp in UTC, to the millisecond. A stamp of the first year of the epoch is no date but the time since a
/// simulation or a machine began: then the seconds.
pub(super) fn utc(stamp_ns: i64) -> String {
    let ms = stamp_ns.div_euclid(1_000_000);
    if (0..FIRST_YEAR_MS).contains(&ms) {
        return format!("{}.{:03} s", ms / 1000, ms % 1000);
    }
    let (year, month, day) = date(ms.div_euclid(DAY_MS));
    let ms = ms.rem_euclid(DAY_MS);
    let (h, m, s) = (ms / 3_600_000, ms / 60_000 % 60, ms / 1000 % 60);
    format!("{year}-{month:02}-{day:02} {h:02}:{m:02}:{s:02}.{:03} UTC", ms % 1000)
}

/// Milliseconds of a day.
const DAY_MS: i64 = 86_400_000;
/// Milliseconds of 1970.
const FIRST_YEAR_MS: i64 = 365 * DAY_MS;

/// Year, month and day of the Gregorian calendar, `days` after 1970-01-01 (H. Hinnant, "chrono-compatible low-level date
/// algorithms": years are counted from March, so that the leap day is the last).
fn date(days: i64) -> (i64, i64, i64) {
    let from_march_0 = days + 719_468;
    let era = from_march_0.div_euclid(146_097);
    let day_of_era = from_march_0.rem_euclid(146_097);
    let year_of_era = (day_of_era - day_of_era / 1_460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_from_march = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_from_march + 2) / 5 + 1;
    let month = if month_from_march < 10 { month_from_march + 3 } else { month_from_march - 9 };
    (year_of_era + era * 400 + i64::from(month <= 2), month, day)
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
        assert_eq!(utc(1_700_000_000_123_000_000), "2023-11-14 22:13:20.123 UTC");
        assert_eq!(utc(951_782_400_000_000_000), "2000-02-29 00:00:00.000 UTC");
        assert_eq!(utc(-1), "1969-12-31 23:59:59.999 UTC");
        assert_eq!(utc(12_345_000_000), "12.345 s");
    }
}
