//! Gaussians read back from a results folder: the map, or one step.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use glam::{DQuat, DVec3, Quat, Vec3};

use crate::bag::Bag;
use crate::cdr::decode as cdr;
use crate::map::StaticMap;
use crate::msg::PointCloud2;
use crate::output::objects_csv::{OBJECTS_FOLDER, read_objects};
use crate::output::ply::{PlyCloud, read_ply};
use crate::pipeline::messages::ANCHOR_FRAME;
use crate::pipeline::replay::MAP_FOLDER;
use crate::pipeline::sink::PREFIX;
use crate::rigid::Rigid;
use crate::sync::clock::seconds_between;

/// ROS data type codes of the columns read.
const FLOAT32: u8 = 7;
const UINT16: u8 = 4;

/// Gaussians in a local frame, and where that frame lies.
#[derive(Clone)]
pub struct SavedGaussians {
    /// The Gaussians.
    pub cloud: PlyCloud,
    /// Their velocities, m/s; empty for a map.
    pub velocities: Vec<[f32; 3]>,
    /// Their motion groups; empty for a map.
    pub motion_ids: Vec<u16>,
    /// The local frame in the map frame.
    pub map_from_local: Rigid,
}

/// A moving object: its own Gaussians, and where it was.
pub struct SavedObject {
    /// Its Gaussians, in the frame of its box.
    pub cloud: PlyCloud,
    /// Stamp and map_from_box, oldest first.
    poses: Vec<(i64, Rigid)>,
}

impl SavedObject {
    /// map_from_box at a stamp; none before it was first and after it was last seen.
    pub fn pose_at(&self, stamp_ns: i64) -> Option<Rigid> {
        let after = self.poses.partition_point(|p| p.0 < stamp_ns);
        let (b_ns, b) = self.poses.get(after)?;
        if *b_ns == stamp_ns {
            return Some(*b);
        }
        let (a_ns, a) = self.poses.get(after.checked_sub(1)?)?;
        Some(a.interpolate(b, seconds_between(*a_ns, stamp_ns) / seconds_between(*a_ns, *b_ns)))
    }
}

/// Reads the moving objects of a results folder: `objects.csv` and `objects/`.
///
/// # Errors
/// Files that are missing or cannot be read.
pub fn load_objects(folder: &Path) -> Result<Vec<SavedObject>> {
    let mut poses: BTreeMap<u32, Vec<(i64, Rigid)>> = BTreeMap::new();
    for row in read_objects(&folder.join("objects.csv"))? {
        poses.entry(row.id).or_default().push((row.stamp_ns, row.map_from_box));
    }
    let gaussians = folder.join(OBJECTS_FOLDER);
    let mut objects = Vec::new();
    for (id, mut poses) in poses {
        poses.sort_by_key(|p| p.0);
        poses.dedup_by_key(|p| p.0);
        let file = gaussians.join(format!("{id}.ply"));
        if file.exists() {
            objects.push(SavedObject { cloud: read_ply(&file)?.cloud, poses });
        }
    }
    Ok(objects)
}

impl SavedGaussians {
    /// Adds an object's Gaussians where `map_from_box` says, at rest.
    pub fn add(&mut self, cloud: &PlyCloud, map_from_box: &Rigid) {
        let local_from_box = crate::window::relative(&self.map_from_local, map_from_box);
        let turn = local_from_box.rotation.as_quat();
        for i in 0..cloud.len() {
            let p = local_from_box.apply(Vec3::from(cloud.positions[i]).as_dvec3());
            let [w, x, y, z] = cloud.quats[i];
            let q = turn * Quat::from_xyzw(x, y, z, w);
            self.cloud.positions.push(p.as_vec3().to_array());
            self.cloud.quats.push([q.w, q.x, q.y, q.z]);
        }
        self.cloud.colors01.extend_from_slice(&cloud.colors01);
        self.cloud.opacities.extend_from_slice(&cloud.opacities);
        self.cloud.scales.extend_from_slice(&cloud.scales);
    }

    /// Keeps the Gaussians that `keep` says, by number.
    pub fn retain(&mut self, keep: impl Fn(usize) -> bool) {
        let kept: Vec<usize> = (0..self.cloud.len()).filter(|&i| keep(i)).collect();
        fn pick<T: Copy>(from: &mut Vec<T>, kept: &[usize]) {
            *from = kept.iter().filter_map(|&i| from.get(i).copied()).collect();
        }
        let c = &mut self.cloud;
        for column in [&mut c.positions, &mut c.colors01, &mut c.scales, &mut self.velocities] {
            pick(column, &kept);
        }
        pick(&mut c.opacities, &kept);
        pick(&mut c.quats, &kept);
        pick(&mut self.motion_ids, &kept);
    }
}

/// What a path given as a map names.
#[derive(Debug, PartialEq, Eq)]
pub enum MapPlace {
    /// The folder of a map's own files.
    Folder(PathBuf),
    /// A PLY file.
    Ply(PathBuf),
}

/// Finds the map of a results folder, of its `map/`, or of a PLY file; `whole` prefers the map's own files to `map.ply`, which may be
/// thinned out. None when there is no map.
pub fn find_map(path: &Path, whole: bool) -> Option<MapPlace> {
    if !path.is_dir() {
        return path.is_file().then(|| MapPlace::Ply(path.to_owned()));
    }
    if StaticMap::is_saved_in(path) {
        return Some(MapPlace::Folder(path.to_owned()));
    }
    let (folder, ply) = (path.join(MAP_FOLDER), path.join("map.ply"));
    let folder = StaticMap::is_saved_in(&folder).then_some(MapPlace::Folder(folder));
    let ply = ply.is_file().then_some(MapPlace::Ply(ply));
    if whole { folder.or(ply) } else { ply.or(folder) }
}

/// Reads a map's own files.
pub fn load_map(folder: &Path) -> Result<SavedGaussians> {
    let cloud = StaticMap::open(folder, false)?.0.cloud()?;
    let map_from_local = Rigid::new(DQuat::IDENTITY, cloud.origin);
    let cloud = PlyCloud {
        positions: cloud.positions,
        colors01: cloud.colors01,
        opacities: cloud.opacities,
        scales: cloud.scales,
        quats: cloud.quats,
    };
    Ok(SavedGaussians { cloud, velocities: Vec::new(), motion_ids: Vec::new(), map_from_local })
}

/// Reads `map.ply`.
pub fn load_ply(path: &Path) -> Result<SavedGaussians> {
    let file = read_ply(path)?;
    let map_from_local = Rigid::new(DQuat::IDENTITY, DVec3::from_array(file.origin_m));
    Ok(SavedGaussians { cloud: file.cloud, velocities: Vec::new(), motion_ids: Vec::new(), map_from_local })
}

/// Reads one step's Gaussians from `outputs.mcap`; the last step when `step` is not given.
pub fn load_step(path: &Path, step: Option<usize>) -> Result<SavedGaussians> {
    let bag = Bag::open(path).with_context(|| format!("cannot read {}", path.display()))?;
    let name = format!("{PREFIX}/gaussians");
    let find = |name: &str| bag.topics().iter().position(|t| t.name == name);
    let Some(topic) = find(&name) else { bail!("{} has no topic {name}", path.display()) };
    let count = bag.topics()[topic].count as usize;
    let wanted = step.unwrap_or(count.saturating_sub(1));
    if wanted >= count {
        bail!("{} has {count} steps, numbered from 0; there is no step {wanted}", path.display());
    }
    let message = bag.messages(&[topic])?.nth(wanted).context("the bag ended before that step")??;
    let cloud = cdr::point_cloud2(&message.data)?;
    let map_from_local = match find("/tf") {
        Some(tf) => anchor_at(&bag, tf, cloud.header.stamp_ns)?,
        None => bail!("{} has no /tf, so nobody knows where {ANCHOR_FRAME} was", path.display()),
    };
    columns(&cloud, map_from_local)
}

fn anchor_at(bag: &Bag, tf: usize, stamp_ns: i64) -> Result<Rigid> {
    for message in bag.messages(&[tf])? {
        for t in cdr::tf_message(&message?.data)? {
            if t.child_frame_id == ANCHOR_FRAME && t.header.stamp_ns == stamp_ns {
                return t.transform.normalized().context("the anchor's transform is not a rotation");
            }
        }
    }
    bail!("no transform of {ANCHOR_FRAME} at {stamp_ns} ns")
}

/// The columns of a Gaussian cloud by name.
fn columns(cloud: &PointCloud2, map_from_local: Rigid) -> Result<SavedGaussians> {
    let n = cloud.width as usize * cloud.height as usize;
    let step = cloud.point_step as usize;
    if step == 0 || cloud.data.len() < n.saturating_mul(step) {
        bail!("cloud of {n} points of {step} bytes has {} bytes", cloud.data.len());
    }
    let offset = |name: &str, datatype: u8, bytes: usize| -> Result<usize> {
        let field = cloud.fields.iter().find(|f| f.name == name && f.datatype == datatype);
        let field = field.with_context(|| format!("cloud has no column {name} of type {datatype}"))?;
        let end = field.offset as usize + bytes;
        if end <= step { Ok(field.offset as usize) } else { bail!("column {name} ends at byte {end} of {step}") }
    };
    let at = |point: &[u8], o: usize| f32::from_le_bytes([point[o], point[o + 1], point[o + 2], point[o + 3]]);
    let mut offsets = Vec::new();
    let names = "x y z rgb vx vy vz opacity scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3";
    for name in names.split(' ') {
        offsets.push(offset(name, FLOAT32, 4)?);
    }
    let group = offset("motion_id", UINT16, 2)?;
    let (mut out, mut velocities, mut motion_ids) = (PlyCloud::default(), Vec::with_capacity(n), Vec::with_capacity(n));
    for point in cloud.data.chunks_exact(step).take(n) {
        let v: Vec<f32> = offsets.iter().map(|&o| at(point, o)).collect();
        let bytes = v[3].to_bits().to_le_bytes();
        out.positions.push([v[0], v[1], v[2]]);
        out.colors01.push([bytes[2], bytes[1], bytes[0]].map(|b| b as f32 / 255.0));
        velocities.push([v[4], v[5], v[6]]);
        out.opacities.push(v[7]);
        out.scales.push([v[8], v[9], v[10]]);
        out.quats.push([v[11], v[12], v[13], v[14]]);
        motion_ids.push(u16::from_le_bytes([point[group], point[group + 1]]));
    }
    Ok(SavedGaussians { cloud: out, velocities, motion_ids, map_from_local })
}
