//! Moving objects as CSV, one object and step a row.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

use super::OutputError;
use crate::objects::MovingObject;

/// The header line. The box is centred at `x_m y_m z_m`, turned by `yaw_rad` about z; its size is that of everything
/// seen of the object, the same in all its rows. Standard deviations of the velocity are the last ones.
pub const OBJECTS_HEADER: &str = "object_id,stamp_ns,x_m,y_m,z_m,yaw_rad,length_m,width_m,height_m,vx_mps,vy_mps,vz_mps,\
sigma_vx_mps,sigma_vy_mps,sigma_vz_mps,gaussians";

/// Writes objects as they end, under a temporary name until it is finished.
#[derive(Debug)]
pub struct ObjectsWriter {
    out: BufWriter<File>,
    part: PathBuf,
    path: PathBuf,
}

impl ObjectsWriter {
    /// Starts `path` (under its temporary name) with the header line.
    pub fn create(path: &Path) -> Result<Self, OutputError> {
        let part = path.with_extension("csv.part");
        let mut out = BufWriter::new(File::create(&part).map_err(OutputError::io(&part))?);
        writeln!(out, "{OBJECTS_HEADER}").map_err(OutputError::io(&part))?;
        Ok(Self { out, part, path: path.to_owned() })
    }

    /// Adds an object: its poses of the last minute of its life. States that are not finite are left out; how many.
    pub fn write(&mut self, object: &MovingObject) -> Result<usize, OutputError> {
        let (size, center) = (object.size_m(), object.box_center());
        let c = object.velocity_covariance();
        let sigma = [c.x_axis.x, c.y_axis.y, c.z_axis.z].map(|v| v.max(0.0).sqrt());
        let mut left_out = 0;
        for state in object.states() {
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
            writeln!(self.out, "{},{},{},{}", object.id, state.stamp_ns, text.join(","), object.model().len())
                .map_err(OutputError::io(&self.part))?;
        }
        self.out.flush().map_err(OutputError::io(&self.part))?;
        Ok(left_out)
    }

    /// Gives the file its name.
    pub fn finish(mut self) -> Result<(), OutputError> {
        self.out.flush().map_err(OutputError::io(&self.part))?;
        std::fs::rename(&self.part, &self.path).map_err(OutputError::io(&self.path))
    }
}
