//! The header of a PLY file: where the columns we need lie in a row.

/// The columns written, in order.
pub(super) const COLUMNS: [&str; 17] = [
    "x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0",
    "rot_1", "rot_2", "rot_3",
];

/// The columns read: all but the normals, which the layout carries unused and some programs leave out.
pub(super) const NEEDED: [&str; 14] = [
    "x", "y", "z", "f_dc_0", "f_dc_1", "f_dc_2", "opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2",
    "rot_3",
];

/// Longest header that is looked through for its end, bytes; with 45 f_rest columns it has about 2000.
const MAX_HEADER_BYTES: usize = 1 << 20;

/// What a header says.
#[derive(Debug)]
pub(super) struct Header {
    /// Byte the rows start at.
    pub data_start: usize,
    /// Rows.
    pub count: u64,
    /// Bytes per row.
    pub stride: u64,
    /// Byte offset of each of [`NEEDED`] in a row.
    pub offsets: [usize; NEEDED.len()],
    /// `origin_m`, zero when the file does not say.
    pub origin_m: [f64; 3],
    /// Comments but for the origin.
    pub comments: Vec<String>,
}

fn type_size(name: &str) -> Option<u64> {
    Some(match name {
        "char" | "uchar" | "int8" | "uint8" => 1,
        "short" | "ushort" | "int16" | "uint16" => 2,
        "int" | "uint" | "int32" | "uint32" | "float" | "float32" => 4,
        "double" | "float64" => 8,
        _ => return None,
    })
}

fn parse_origin(words: &[&str]) -> Result<[f64; 3], String> {
    let bad = || format!("its comment origin_m {words:?} is not three finite numbers");
    let numbers: Vec<f64> = words.iter().map(|w| w.parse()).collect::<Result<_, _>>().map_err(|_| bad())?;
    let origin: [f64; 3] = numbers.try_into().map_err(|_| bad())?;
    if origin.iter().all(|v| v.is_finite()) { Ok(origin) } else { Err(bad()) }
}

/// Reads the header at the start of `bytes`; the error says what is wrong in words that follow the file's name.
pub(super) fn parse_header(bytes: &[u8]) -> Result<Header, String> {
    if !(bytes.starts_with(b"ply\n") || bytes.starts_with(b"ply\r\n")) {
        return Err("not a PLY file (it does not start with \"ply\")".into());
    }
    let mut header = Header {
        data_start: 0,
        count: 0,
        stride: 0,
        offsets: [usize::MAX; NEEDED.len()],
        origin_m: [0.0; 3],
        comments: Vec::new(),
    };
    let (mut format_seen, mut vertex_seen, mut in_vertex) = (false, false, false);
    let mut at = 0usize;
    loop {
        let rest = bytes.get(at..bytes.len().min(MAX_HEADER_BYTES)).unwrap_or_default();
        let Some(len) = rest.iter().position(|&b| b == b'\n') else {
            return Err("its header has no end_header line; the file is cut short or not PLY".into());
        };
        let line = std::str::from_utf8(&rest[..len]).map_err(|_| "its header is not text".to_owned())?.trim_end();
        at += len + 1;
        let words: Vec<&str> = line.split_ascii_whitespace().collect();
        match words.as_slice() {
            ["ply"] | [] => {}
            ["format", "binary_little_endian", _] => format_seen = true,
            ["format", other, ..] => return Err(format!("its format is {other}; binary_little_endian is needed")),
            ["comment", "origin_m", numbers @ ..] => header.origin_m = parse_origin(numbers)?,
            ["comment" | "obj_info", ..] => {
                let text = line.split_once(' ').map_or("", |(_, text)| text);
                header.comments.push(text.to_owned());
            }
            ["element", "vertex", count] => {
                if vertex_seen {
                    return Err("it has two vertex elements".into());
                }
                header.count = count.parse().map_err(|_| format!("its vertex count {count:?} is not a number"))?;
                (vertex_seen, in_vertex) = (true, true);
            }
            ["element", _, "0"] => in_vertex = false,
            ["element", name, count] => {
                return Err(format!("it has {count} {name}; only files of Gaussians (element vertex) are read"));
            }
            ["property", "list", ..] if in_vertex => return Err("its vertices have a list property".into()),
            ["property", kind, name] if in_vertex => add_column(&mut header, kind, name)?,
            ["property", ..] => {}
            ["end_header"] => break,
            _ => return Err(format!("its header line {line:?} is not understood")),
        }
    }
    if !format_seen || !vertex_seen {
        return Err("its header lacks format or element vertex".into());
    }
    if let Some(k) = header.offsets.iter().position(|&o| o == usize::MAX) {
        return Err(format!("it has no column {}; it is not a file of Gaussians", NEEDED[k]));
    }
    header.data_start = at;
    Ok(header)
}

fn add_column(header: &mut Header, kind: &str, name: &str) -> Result<(), String> {
    let size = type_size(kind).ok_or_else(|| format!("its column {name} has the unknown type {kind}"))?;
    if let Some(k) = NEEDED.iter().position(|n| *n == name) {
        if !matches!(kind, "float" | "float32") {
            return Err(format!("its column {name} is {kind}; float is needed"));
        }
        if header.offsets[k] != usize::MAX {
            return Err(format!("it has the column {name} twice"));
        }
        // Below MAX_HEADER_BYTES * 8, so it fits.
        header.offsets[k] = header.stride as usize;
    }
    header.stride += size;
    Ok(())
}
