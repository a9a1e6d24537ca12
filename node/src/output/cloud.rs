//! Point clouds as the node publishes them: column layout, units, and the rule that nothing non-finite gets out.
//!
//! All columns are little-endian. Positions are metres and velocities m/s along the axes of the cloud's frame, `rgb` is
//! the packed colour RViz and PCL read (bytes b g r 0 seen as one float32), opacity 0 to 1, `scale_*` linear standard
//! deviations in metres, `rot_*` the unit quaternion w x y z.
//!
//! | cloud | columns (type float32 unless said) | bytes per point |
//! |---|---|---|
//! | Gaussians | x y z rgb vx vy vz opacity scale_0..2 rot_0..3, motion_id uint16, track_id uint32 | 68 |
//! | flow (organised, one point a pixel) | x y z vx vy vz, valid uint8 (0: no surface there, all else is 0) | 28 |
//! | map | x y z rgb opacity scale_0..2 rot_0..3 | 48 |

use super::OutputError;
use crate::msg::{Header, PointCloud2, PointField};

/// ROS data type code of float32.
const FLOAT32: u8 = 7;
/// ROS data type code of uint8.
const UINT8: u8 = 2;
/// ROS data type code of uint16.
pub(super) const UINT16: u8 = 4;
/// ROS data type code of uint32.
pub(super) const UINT32: u8 = 6;

/// Track number of a Gaussian that belongs to no trajectory.
pub const NO_TRACK: u32 = u32::MAX;

/// Gaussians at one time, as arrays of one length.
#[derive(Debug, Clone, Copy)]
pub struct GaussianCloud<'a> {
    /// Centres, metres.
    pub positions: &'a [[f32; 3]],
    /// Colours, 0 to 1; values outside are clamped.
    pub colors01: &'a [[f32; 3]],
    /// Velocities, m/s.
    pub velocities: &'a [[f32; 3]],
    /// Opacities, 0 to 1.
    pub opacities: &'a [f32],
    /// Linear standard deviations, metres.
    pub scales: &'a [[f32; 3]],
    /// Orientations, w x y z.
    pub quats: &'a [[f32; 4]],
    /// Motion group of each Gaussian.
    pub motion_ids: &'a [u16],
    /// Trajectory of each Gaussian, or [`NO_TRACK`].
    pub track_ids: &'a [u32],
}

/// Gaussians of the map: the same arrays without motion.
#[derive(Debug, Clone, Copy)]
pub struct MapCloud<'a> {
    /// Centres, metres.
    pub positions: &'a [[f32; 3]],
    /// Colours, 0 to 1; values outside are clamped.
    pub colors01: &'a [[f32; 3]],
    /// Opacities, 0 to 1.
    pub opacities: &'a [f32],
    /// Linear standard deviations, metres.
    pub scales: &'a [[f32; 3]],
    /// Orientations, w x y z.
    pub quats: &'a [[f32; 4]],
}

/// Scene flow of a picture: one point a pixel, row-major.
#[derive(Debug, Clone, Copy)]
pub struct FlowCloud<'a> {
    /// Picture width, pixels.
    pub width: usize,
    /// Picture height, pixels.
    pub height: usize,
    /// Surface points, metres.
    pub positions: &'a [[f32; 3]],
    /// Velocities, m/s.
    pub velocities: &'a [[f32; 3]],
    /// Whether the pixel shows a surface (and not the sky).
    pub valid: &'a [bool],
}

/// A cloud and how many points were left out of it, or invalidated in it, because a number was not finite.
#[derive(Debug, Clone, PartialEq)]
pub struct BuiltCloud {
    /// The message.
    pub cloud: PointCloud2,
    /// Points that were not finite.
    pub non_finite: usize,
}

/// Lays columns out one after the other, each aligned to its own size.
pub(super) struct Layout {
    fields: Vec<PointField>,
    end: u32,
}

impl Layout {
    pub(super) fn new() -> Self {
        Self { fields: Vec::new(), end: 0 }
    }

    pub(super) fn column(mut self, name: &str, datatype: u8) -> Self {
        let size = match datatype {
            UINT8 => 1,
            UINT16 => 2,
            _ => 4,
        };
        let offset = self.end.next_multiple_of(size);
        self.fields.push(PointField { name: name.to_owned(), offset, datatype, count: 1 });
        self.end = offset + size;
        self
    }

    pub(super) fn floats(self, names: &[&str]) -> Self {
        names.iter().fold(self, |layout, name| layout.column(name, FLOAT32))
    }

    /// Rows are padded to 4 bytes so that float columns stay aligned in an array of points.
    pub(super) fn point_step(&self) -> u32 {
        self.end.next_multiple_of(4)
    }
}

pub(super) const GEOMETRY: [&str; 8] = ["opacity", "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3"];

/// Colour as RViz and PCL read it: 0x00RRGGBB seen as a float32, which is always finite.
pub fn pack_rgb(color01: [f32; 3]) -> f32 {
    let [r, g, b] = color01.map(|c| (c.clamp(0.0, 1.0) * 255.0).round() as u32);
    f32::from_bits(r << 16 | g << 8 | b)
}

fn check(what: &'static str, expected: usize, got: usize) -> Result<(), OutputError> {
    if expected == got { Ok(()) } else { Err(OutputError::Length { what, expected, got }) }
}

pub(super) fn put(data: &mut Vec<u8>, values: &[f32]) {
    values.iter().for_each(|v| data.extend_from_slice(&v.to_le_bytes()));
}

pub(super) fn finite(groups: &[&[f32]]) -> bool {
    groups.iter().all(|g| g.iter().all(|v| v.is_finite()))
}

/// An unorganised cloud from its rows.
pub(super) fn unorganised(
    header: Header,
    layout: Layout,
    data: Vec<u8>,
    total: usize,
) -> Result<BuiltCloud, OutputError> {
    let point_step = layout.point_step();
    let count = data.len() / point_step as usize;
    // Size fields are 32-bit on the wire.
    let row_step = u32::try_from(data.len()).map_err(|_| OutputError::Length {
        what: "cloud bytes",
        expected: u32::MAX as usize,
        got: data.len(),
    })?;
    let cloud = PointCloud2 {
        header,
        height: 1,
        width: count as u32,
        fields: layout.fields,
        point_step,
        row_step,
        data,
        is_dense: true,
    };
    Ok(BuiltCloud { cloud, non_finite: total - count })
}

/// The Gaussians topic. Rows with a number that is not finite are left out and counted.
pub fn gaussian_cloud(header: Header, input: &GaussianCloud) -> Result<BuiltCloud, OutputError> {
    let n = input.positions.len();
    check("colors01", n, input.colors01.len())?;
    check("velocities", n, input.velocities.len())?;
    check("opacities", n, input.opacities.len())?;
    check("scales", n, input.scales.len())?;
    check("quats", n, input.quats.len())?;
    check("motion_ids", n, input.motion_ids.len())?;
    check("track_ids", n, input.track_ids.len())?;
    let layout = Layout::new()
        .floats(&["x", "y", "z", "rgb", "vx", "vy", "vz"])
        .floats(&GEOMETRY)
        .column("motion_id", UINT16)
        .column("track_id", UINT32);
    let mut data = Vec::with_capacity(n.saturating_mul(layout.point_step() as usize));
    for i in 0..n {
        let (p, c, v) = (&input.positions[i], input.colors01[i], &input.velocities[i]);
        let (o, s, q) = (input.opacities[i], &input.scales[i], &input.quats[i]);
        if finite(&[p, &c, v, &[o], s, q]) {
            put(&mut data, p);
            put(&mut data, &[pack_rgb(c)]);
            put(&mut data, v);
            put(&mut data, &[o]);
            put(&mut data, s);
            put(&mut data, q);
            data.extend_from_slice(&input.motion_ids[i].to_le_bytes());
            data.extend_from_slice(&[0; 2]);
            data.extend_from_slice(&input.track_ids[i].to_le_bytes());
        }
    }
    unorganised(header, layout, data, n)
}

/// The map topic. Rows with a number that is not finite are left out and counted.
pub fn map_cloud(header: Header, input: &MapCloud) -> Result<BuiltCloud, OutputError> {
    let n = input.positions.len();
    check("colors01", n, input.colors01.len())?;
    check("opacities", n, input.opacities.len())?;
    check("scales", n, input.scales.len())?;
    check("quats", n, input.quats.len())?;
    let layout = Layout::new().floats(&["x", "y", "z", "rgb"]).floats(&GEOMETRY);
    let mut data = Vec::with_capacity(n.saturating_mul(layout.point_step() as usize));
    for i in 0..n {
        let (p, c, o) = (&input.positions[i], input.colors01[i], input.opacities[i]);
        let (s, q) = (&input.scales[i], &input.quats[i]);
        if finite(&[p, &c, &[o], s, q]) {
            put(&mut data, p);
            put(&mut data, &[pack_rgb(c), o]);
            put(&mut data, s);
            put(&mut data, q);
        }
    }
    unorganised(header, layout, data, n)
}

/// The flow topic: organised, so row and column are the pixel's. A pixel without a surface, or with a number that is not
/// finite, has `valid` 0 and zeros elsewhere; `is_dense` says whether every pixel is valid.
pub fn flow_cloud(header: Header, input: &FlowCloud) -> Result<BuiltCloud, OutputError> {
    let n = input.positions.len();
    check("flow width * height", n, input.width.saturating_mul(input.height))?;
    check("velocities", n, input.velocities.len())?;
    check("valid", n, input.valid.len())?;
    let layout = Layout::new().floats(&["x", "y", "z", "vx", "vy", "vz"]).column("valid", UINT8);
    let mut data = Vec::with_capacity(n.saturating_mul(layout.point_step() as usize));
    let (mut non_finite, mut is_dense) = (0, true);
    for i in 0..n {
        let is_finite = finite(&[&input.positions[i], &input.velocities[i]]);
        let valid = input.valid[i] && is_finite;
        non_finite += usize::from(input.valid[i] && !is_finite);
        is_dense &= valid;
        put(&mut data, if valid { &input.positions[i] } else { &[0.0; 3] });
        put(&mut data, if valid { &input.velocities[i] } else { &[0.0; 3] });
        data.extend_from_slice(&[u8::from(valid), 0, 0, 0]);
    }
    let mut built = unorganised(header, layout, data, n)?;
    // Each fits: their product did.
    built.cloud.height = input.height as u32;
    built.cloud.width = input.width as u32;
    built.cloud.row_step = built.cloud.point_step * input.width as u32;
    built.cloud.is_dense = is_dense;
    built.non_finite = non_finite;
    Ok(built)
}

/// Values in the float columns of a cloud that are not finite: 0 for every cloud built here, counted over what is sent.
pub fn non_finite_values(cloud: &PointCloud2) -> usize {
    let offsets: Vec<usize> =
        cloud.fields.iter().filter(|f| f.datatype == FLOAT32).map(|f| f.offset as usize).collect();
    let value = |point: &[u8], at: usize| {
        point.get(at..at + 4).and_then(|b| b.try_into().ok()).map_or(f32::NAN, f32::from_le_bytes)
    };
    let points = cloud.data.chunks_exact((cloud.point_step as usize).max(1));
    points.map(|point| offsets.iter().filter(|&&at| !value(point, at).is_finite()).count()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn field<'a>(cloud: &'a PointCloud2, point: usize, name: &str) -> &'a [u8] {
        let f = cloud.fields.iter().find(|f| f.name == name).unwrap();
        &cloud.data[point * cloud.point_step as usize + f.offset as usize..]
    }

    fn float(cloud: &PointCloud2, point: usize, name: &str) -> f32 {
        f32::from_le_bytes(field(cloud, point, name)[..4].try_into().unwrap())
    }

    fn header() -> Header {
        Header { stamp_ns: 1, frame_id: "map".into() }
    }

    #[test]
    fn gaussians_lie_where_the_fields_say_and_bad_ones_are_left_out() {
        let quats = [[1.0, 0.0, 0.0, 0.0], [0.5, 0.5, -0.5, 0.5], [0.1, 0.2, 0.3, 0.4]];
        let input = GaussianCloud {
            positions: &[[1.0, 2.0, 3.0], [4.0, 5.0, 6.0], [7.0, 8.0, 9.0]],
            colors01: &[[1.0, 0.5, 0.0], [0.0; 3], [2.0, -1.0, 1.0]],
            velocities: &[[0.1, 0.2, 0.3], [f32::NAN, 0.0, 0.0], [-1.0, -2.0, -3.0]],
            opacities: &[0.25, 0.5, 0.75],
            scales: &[[0.01, 0.02, 0.03]; 3],
            quats: &quats,
            motion_ids: &[1, 2, 65535],
            track_ids: &[NO_TRACK, 5, 70_000],
        };
        let built = gaussian_cloud(header(), &input).unwrap();
        let cloud = &built.cloud;
        assert_eq!(non_finite_values(cloud), 0);
        let mut spoiled = cloud.clone();
        let y = cloud.point_step as usize + 4;
        spoiled.data[y..y + 4].copy_from_slice(&f32::INFINITY.to_le_bytes());
        assert_eq!(non_finite_values(&spoiled), 1, "the count sees what the builders would let through");
        assert_eq!((cloud.width, cloud.height, cloud.point_step, built.non_finite), (2, 1, 68, 1));
        assert_eq!(cloud.data.len(), 2 * 68);
        assert_eq!(float(cloud, 0, "rgb").to_bits(), 0x00FF_8000);
        assert_eq!(float(cloud, 1, "rgb").to_bits(), 0x00FF_00FF);
        assert_eq!((float(cloud, 1, "x"), float(cloud, 1, "vz"), float(cloud, 1, "rot_3")), (7.0, -3.0, 0.4));
        assert_eq!((float(cloud, 0, "opacity"), float(cloud, 0, "scale_2")), (0.25, 0.03));
        assert_eq!(u16::from_le_bytes(field(cloud, 1, "motion_id")[..2].try_into().unwrap()), 65535);
        assert_eq!(u32::from_le_bytes(field(cloud, 1, "track_id")[..4].try_into().unwrap()), 70_000);
        let short = GaussianCloud { quats: &quats[..2], ..input };
        assert!(matches!(gaussian_cloud(header(), &short), Err(OutputError::Length { what: "quats", .. })));
    }

    #[test]
    fn flow_keeps_the_shape_of_the_picture_and_zeroes_what_is_not_valid() {
        let input = FlowCloud {
            width: 2,
            height: 2,
            positions: &[[1.0; 3], [2.0; 3], [f32::INFINITY; 3], [4.0; 3]],
            velocities: &[[0.5; 3]; 4],
            valid: &[true, false, true, true],
        };
        let built = flow_cloud(header(), &input).unwrap();
        let cloud = &built.cloud;
        assert_eq!((cloud.width, cloud.height, cloud.row_step, cloud.is_dense), (2, 2, 56, false));
        assert_eq!(built.non_finite, 1);
        let valid: Vec<u8> = (0..4).map(|i| field(cloud, i, "valid")[0]).collect();
        assert_eq!(valid, [1, 0, 0, 1]);
        assert_eq!((float(cloud, 1, "x"), float(cloud, 1, "vx"), float(cloud, 3, "z")), (0.0, 0.0, 4.0));
        assert!(
            cloud
                .data
                .chunks_exact(28)
                .all(|p| (0..6).all(|k| { f32::from_le_bytes(p[4 * k..4 * k + 4].try_into().unwrap()).is_finite() }))
        );
        assert!(flow_cloud(header(), &FlowCloud { width: 3, ..input }).is_err());
    }

    #[test]
    fn an_empty_map_is_a_cloud_of_no_points() {
        let empty = MapCloud { positions: &[], colors01: &[], opacities: &[], scales: &[], quats: &[] };
        let built = map_cloud(header(), &empty).unwrap();
        assert_eq!((built.cloud.width, built.cloud.row_step, built.cloud.point_step), (0, 0, 48));
        assert_eq!(built.cloud.fields.len(), 12);
    }
}
