//! `storm map`: what a saved map holds, and the map as PLY.

use std::path::{Path, PathBuf};

use anyhow::Result;

use super::Outcome;
use crate::map::StaticMap;
use crate::output::ply::{PlyCloud, write_ply};
use crate::saved::{self, MapPlace};

/// Arguments of `storm map`.
#[derive(Debug, clap::Args)]
pub struct Args {
    /// A results folder, its map/ (also of a run that was killed), or a PLY.
    map: PathBuf,
    /// Write the map in the 3DGS layout.
    #[arg(long)]
    out: Option<PathBuf>,
    /// Load what is whole when tiles are damaged; each damaged one is named.
    #[arg(long)]
    salvage: bool,
}

/// Loads, checks, says, writes.
pub fn run(args: &Args) -> Result<Outcome> {
    let folder = match saved::find_map(&args.map, true) {
        Some(MapPlace::Folder(folder)) => folder,
        Some(MapPlace::Ply(ply)) => return of_ply(&ply, args.out.as_deref()),
        // The error names what is missing.
        None => args.map.clone(),
    };
    let (map, problems) = StaticMap::open(&folder, args.salvage)?;
    for problem in &problems {
        complain!("lost: {problem}");
    }
    let o = map.origin();
    say!(
        "{} Gaussians in {} tiles of {} m, finest voxels {} m, {:.1} MB on disk; origin {} {} {}; {} windows",
        map.len(),
        map.tile_count(),
        map.config().tile_m,
        map.config().voxel_m,
        map.disk_bytes() as f64 / 1e6,
        o.x,
        o.y,
        o.z,
        map.revision()
    );
    if let Some(path) = &args.out {
        let cloud = map.cloud()?;
        let notes =
            ["static map without the sky; positions in metres, relative to origin_m in the map frame".to_string()];
        let ply = PlyCloud {
            positions: cloud.positions,
            colors01: cloud.colors01,
            opacities: cloud.opacities,
            scales: cloud.scales,
            quats: cloud.quats,
        };
        write_ply(path, &ply, cloud.origin.to_array(), &notes)?;
    }
    Ok(if problems.is_empty() { Outcome::Done } else { Outcome::Lost })
}

/// The same of a PLY, which holds the Gaussians and nothing of tiles.
fn of_ply(ply: &Path, out: Option<&Path>) -> Result<Outcome> {
    let saved = saved::load_ply(ply)?;
    let o = saved.map_from_local.translation;
    say!("{} Gaussians in {}; origin {} {} {}", saved.cloud.len(), ply.display(), o.x, o.y, o.z);
    if let Some(out) = out {
        write_ply(out, &saved.cloud, o.to_array(), &["written from a PLY".to_string()])?;
    }
    Ok(Outcome::Done)
}
