//! The live map's folder: what a start and `~/load_map` do with it.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};

use crate::config::{Config, MapConfig};
use crate::map::StaticMap;

/// The map a live run starts with. A folder that holds a map already is never emptied.
pub(super) fn open_map(config: &Config) -> Result<StaticMap> {
    let (dir, load) = (Path::new(&config.live.map_dir), Path::new(&config.map.load));
    let wanted = &config.map;
    if dir.as_os_str().is_empty() {
        if load.as_os_str().is_empty() {
            return Ok(StaticMap::new(wanted));
        }
        bail!("map.load = {}: a live map to go on from needs live.map_dir, a folder to keep it in", load.display());
    }
    if load == dir {
        return Ok(StaticMap::load(wanted, dir, false)?.0);
    }
    if StaticMap::open(dir, true).is_ok() {
        let dir = dir.display();
        bail!("live.map_dir = {dir} holds a saved map; set map.load={dir} to go on from it, or name another folder");
    }
    let made = || format!("live.map_dir = {}", dir.display());
    std::fs::create_dir_all(dir).with_context(made)?;
    if load.as_os_str().is_empty() {
        return StaticMap::in_folder(wanted, dir).with_context(made);
    }
    StaticMap::copied(wanted, load, dir).with_context(made)
}

/// The map `map.load` names, read while the present one goes on; it replaces the files in `live.map_dir`.
pub(super) fn reload_map(wanted: &MapConfig, dir: &Path) -> Result<StaticMap> {
    let load = PathBuf::from(&wanted.load);
    if dir.as_os_str().is_empty() || load.as_os_str().is_empty() {
        bail!("set map.load to the folder of a saved map, and live.map_dir to a folder to keep it in");
    }
    // Read once before anything is replaced.
    let (map, _) = StaticMap::load(wanted, &load, false)?;
    if load == dir {
        return Ok(map);
    }
    drop(map);
    Ok(StaticMap::copied(wanted, &load, dir)?)
}
