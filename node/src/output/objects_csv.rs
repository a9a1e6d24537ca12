//! Moving objects as CSV, one object and step a row, and their Gaussians as PLY, one file each.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use glam::{DQuat, DVec3};

use super::OutputError;
use super::ply::{PlyCloud, write_ply};
use crate::objects::MovingObject;
use crate::rigid::Rigid;

/// Folder of the objects' own Gaussians, beside `objects.csv`: `<object_id>.ply`, in the frame of the object's box.
pub const OBJECTS_FOLDER: &str = "objects";

/// The header line. The box is centred at `x_m y_m z_m`, turned by `yaw_rad` about z; its size is that of everything
/// seen of the object, the same in all its rows. Standard deviations of the velocity are the last ones. The acceleration
/// is empty before half a second of the object was seen.
pub const OBJECTS_HEADER: &str = "object_id,stamp_ns,x_m,y_m,z_m,yaw_rad,length_m,width_m,height_m,vx_mps,vy_mps,vz_mps,\
sigma_vx_mps,sigma_vy_mps,sigma_vz_mps,gaussians,ax_mps2,ay_mps2,az_mps2";

/// One object at one step, as `objects.csv` has it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ObjectRow {
    /// Which object.
    pub id: u32,
    /// The step's stamp, nanoseconds.
    pub stamp_ns: i64,
    /// Its box's frame: at the box's centre, x along the box.
    pub map_from_box: Rigid,
    /// The box's size, metres.
    pub size_m: DVec3,
}

/// Reads `objects.csv`.
///
/// # Errors
/// A file that cannot be read, or a row that is not one of that file.
pub fn read_objects(path: &Path) -> anyhow::Result<Vec<ObjectRow>> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()))?;
    let mut rows = Vec::new();
    for (line, row) in text.lines().enumerate().skip(1) {
        let Some(row) = parse(row) else {
            bail!("{}, line {}: '{row}' is no row of objects.csv", path.display(), line + 1);
        };
        rows.push(row);
    }
    Ok(rows)
}

fn parse(row: &str) -> Option<ObjectRow> {
    let mut fields = row.split(',');
    let (id, stamp_ns) = (fields.next()?.parse().ok()?, fields.next()?.parse().ok()?);
    let n: Vec<f64> = fields.take(7).map(|f| f.parse().ok()).collect::<Option<_>>()?;
    let [x, y, z, yaw, length, width, height] = n[..] else { return None };
    let map_from_box = Rigid::new(DQuat::from_rotation_z(yaw), DVec3::new(x, y, z));
    let size_m = DVec3::new(length, width, height);
    (map_from_box.is_finite() && size_m.is_finite()).then_some(ObjectRow { id, stamp_ns, map_from_box, size_m })
}

/// Writes objects as they end, under a temporary name until it is finished.
#[derive(Debug)]
pub struct ObjectsWriter {
    out: BufWriter<File>,
    part: PathBuf,
    path: PathBuf,
    folder: PathBuf,
}

impl ObjectsWriter {
    /// Starts `path` (under its temporary name) with the header line.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let part = path.with_extension("csv.part");
        let mut out = BufWriter::new(File::create(&part).map_err(OutputError::io(&part))?);
        writeln!(out, "{OBJECTS_HEADER}").map_err(OutputError::io(&part))?;
        let folder = path.with_file_name(OBJECTS_FOLDER);
        match std::fs::remove_dir_all(&folder) {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(OutputError::io(&folder)(e)),
            _ => std::fs::create_dir_all(&folder).map_err(OutputError::io(&folder))?,
        }
        Ok(Self { out, part, path: path.to_owned(), folder })
    }

    /// Adds an object: its poses of the last minute of its life. States that are not finite are left out; how many.
    pub fn write(&mut self, object: &MovingObject) -> Result<usize, OutputError> {
        let (size, center) = (object.size_m(), object.box_center());
        let c = object.velocity_covariance();
        let sigma = [c.x_axis.x, c.y_axis.y, c.z_axis.z].map(|v| v.max(0.0).sqrt());
        let mut left_out = 0;
        for (i, state) in object.states().iter().enumerate() {
            let at = state.map_from_object.apply(center);
            let q = state.map_from_object.rotation;
            let yaw = 2.0 * q.z.atan2(q.w);
            let v = state.velocity_mps;
            let numbers = [at.x, at.y, at.z, yaw, size.x, size.y, size.z, v.x, v.y, v.z, sigma[0], sigma[1], sigma[2]];
            if numbers.iter().any(|x| !x.is_finite()) {
                left_out += 1;
                continue;
            }
            let text: Vec<String> = numbers.iter().map(|x| format!("{x:.4}")).collect();
            let acceleration = match object.acceleration_at(i) {
                Some(a) => format!("{:.4},{:.4},{:.4}", a.x, a.y, a.z),
                None => ",,".into(),
            };
            let (id, stamp_ns, gaussians) = (object.id, state.stamp_ns, object.model().len());
            writeln!(self.out, "{id},{stamp_ns},{},{gaussians},{acceleration}", text.join(","))
                .map_err(OutputError::io(&self.part))?;
        }
        self.out.flush().map_err(OutputError::io(&self.part))?;
        self.write_gaussians(object)?;
        Ok(left_out)
    }

    /// Its own Gaussians, relative to its box's centre.
    fn write_gaussians(&self, object: &MovingObject) -> Result<(), OutputError> {
        let (cloud, center) = (object.model().cloud(), object.box_center());
        if cloud.is_empty() {
            return Ok(());
        }
        let moved = |p: &[f32; 3]| (DVec3::from(p.map(f64::from)) - center).as_vec3().to_array();
        let ply = PlyCloud {
            positions: cloud.positions.iter().map(moved).collect(),
            colors01: cloud.colors01,
            opacities: cloud.opacities,
            scales: cloud.scales,
            quats: cloud.quats,
        };
        let note = format!("moving object {}, in the frame of its box (objects.csv)", object.id);
        write_ply(&self.folder.join(format!("{}.ply", object.id)), &ply, [0.0; 3], &[note])
    }

    /// Gives the file its name.
    pub fn finish(mut self) -> Result<(), OutputError> {
        self.out.flush().map_err(OutputError::io(&self.part))?;
        std::fs::rename(&self.part, &self.path).map_err(OutputError::io(&self.path))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_come_back_and_others_are_named() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("objects.csv");
        std::fs::write(&path, format!("{OBJECTS_HEADER}\n3,1000,10.0,0.5,0.0,1.5,4.0,2.0,1.5,1,0,0,1,1,1,9,,,\n"))
            .unwrap();
        let rows = read_objects(&path).unwrap();
        assert_eq!((rows.len(), rows[0].id, rows[0].stamp_ns), (1, 3, 1000));
        assert_eq!(rows[0].size_m, DVec3::new(4.0, 2.0, 1.5));
        assert_eq!(rows[0].map_from_box.translation, DVec3::new(10.0, 0.5, 0.0));
        for bad in ["1,2", "a,b,c,d,e,f,g,h,i", "1,5,NaN,0,0,0,1,1,1"] {
            std::fs::write(&path, format!("header\n{bad}\n")).unwrap();
            assert!(read_objects(&path).unwrap_err().to_string().contains("line 2"), "{bad}");
        }
    }
}
