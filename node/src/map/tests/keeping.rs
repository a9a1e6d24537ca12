//! Tiles on disk: there and back, deaths, damage, a full disk, what changed, and moved after a loop closure.

use super::*;

fn drive(map: &mut StaticMap, steps: impl Iterator<Item = i64>) {
    for step in steps {
        let pose = Rigid::new(DQuat::IDENTITY, DVec3::new(20.0 * step as f64, 0.0, 0.0));
        insert_all(map, &pose, &random_gaussians(2000, 30.0, (step % 7) as u64));
    }
}

#[test]
fn tiles_that_were_on_disk_are_the_tiles_they_were() {
    let dir = tempfile::tempdir().unwrap();
    let small = MapConfig { max_gaussians: 15_000, max_depth_m: 30.0, ..MapConfig::default() };
    let mut spilling = StaticMap::in_folder(&small, dir.path()).unwrap();
    let mut whole = StaticMap::new(&MapConfig::default());
    // There and back again.
    for map in [&mut spilling, &mut whole] {
        drive(map, (0..30).chain((0..30).rev()));
    }
    let c = spilling.counts();
    assert!(c.spilled > 50 && c.returned > 50 && c.evicted == 0 && c.spill_failed == 0, "{c:?}");
    assert!(spilling.loaded() <= 15_000 && spilling.disk_bytes() > 100_000);
    assert_eq!(spilling.len(), whole.len());
    assert_eq!(spilling.cloud().unwrap(), whole.cloud().unwrap());
    check(&spilling);
    // Saved and loaded, it is the same, and goes on as the same.
    spilling.save().unwrap();
    let (mut loaded, problems) = StaticMap::load(&small, dir.path(), false).unwrap();
    assert!(problems.is_empty());
    assert_eq!(loaded.cloud().unwrap(), whole.cloud().unwrap());
    drive(&mut loaded, 10..14);
    drive(&mut whole, 10..14);
    assert_eq!(loaded.cloud().unwrap(), whole.cloud().unwrap());
    let files = std::fs::read_dir(dir.path()).unwrap().count();
    loaded.save().unwrap();
    assert!(std::fs::read_dir(dir.path()).unwrap().count() <= files + 40, "old versions go");
}

#[test]
fn a_save_that_dies_leaves_the_last_one() {
    let dir = tempfile::tempdir().unwrap();
    let config = MapConfig::default();
    let mut map = StaticMap::in_folder(&config, dir.path()).unwrap();
    drive(&mut map, 0..3);
    map.save().unwrap();
    let saved = map.cloud().unwrap();
    let index = std::fs::read(dir.path().join("map.index")).unwrap();
    drive(&mut map, 1..5);
    map.save().unwrap();
    let newer = map.cloud().unwrap();
    assert_ne!(saved, newer);
    assert_eq!(StaticMap::load(&config, dir.path(), false).unwrap().0.cloud().unwrap(), newer);
    // Death between the tiles and the index: tiles of the next version are there, the index is the old one.
    let copy = tempfile::tempdir().unwrap();
    let mut map = StaticMap::in_folder(&config, copy.path()).unwrap();
    drive(&mut map, 0..3);
    map.save().unwrap();
    drive(&mut map, 1..5);
    for tile in &mut map.tiles {
        tile.sweep();
        map.store.as_mut().unwrap().put(tile).unwrap();
    }
    assert_eq!(std::fs::read(copy.path().join("map.index")).unwrap(), index);
    drop(map);
    assert_eq!(StaticMap::load(&config, copy.path(), false).unwrap().0.cloud().unwrap(), saved);
}

/// Saves happen by the clock on the wall; two runs must still give the same map.
#[test]
fn saving_changes_nothing_in_the_map() {
    let dir = tempfile::tempdir().unwrap();
    let run = |saved: bool| {
        let mut map = StaticMap::in_folder(&MapConfig::default(), dir.path()).unwrap();
        let mut dead = 0;
        for step in 0..12 {
            let mut r = Numbers(500 + step);
            let noise: Vec<f32> = (0..2304).map(|_| 0.15 * (r.next() + r.next() + r.next() - 1.5)).collect();
            // From far to near, so that cells are refined, joined and given up all the while.
            let (g, k) = wall(48, 30.0 - 2.0 * step as f32, |i| noise[i]);
            look(&mut map, 100 * step as i64, DVec3::new(2.0 * step as f64, 0.0, 0.0), &g, &k);
            dead += map.tiles.iter().map(|t| t.cells.len() - t.len()).sum::<usize>();
            if saved {
                map.save().unwrap();
            }
        }
        check(&map);
        (map.cloud().unwrap(), map.counts(), dead)
    };
    let (never, always) = (run(false), run(true));
    assert!(never.2 > 100, "there must have been dead cells: {}", never.2);
    assert_eq!(never, always);
}

#[test]
fn damage_is_refused_by_name_and_the_rest_loads() {
    let dir = tempfile::tempdir().unwrap();
    let config = MapConfig::default();
    let mut map = StaticMap::in_folder(&config, dir.path()).unwrap();
    drive(&mut map, 0..2);
    map.save().unwrap();
    let whole = map.len();
    let mut names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().path()).collect();
    names.retain(|p| p.extension().is_some_and(|e| e == "tile"));
    names.sort();
    let name = names[names.len() / 2].clone();
    let good = std::fs::read(&name).unwrap();
    let mut flipped = good.clone();
    flipped[good.len() / 2] ^= 4;
    let mut claims = good[..24].to_vec();
    claims[12..20].copy_from_slice(&(100u64 << 30).to_le_bytes());
    let mut other_version = good.clone();
    other_version[8] = 9;
    for bad in [flipped, good[..good.len() - 7].to_vec(), claims, other_version, b"hello".to_vec(), Vec::new()] {
        std::fs::write(&name, &bad).unwrap();
        let error = StaticMap::load(&config, dir.path(), false).unwrap_err().to_string();
        assert!(error.contains(name.file_name().unwrap().to_str().unwrap()), "{error}");
        let (rest, problems) = StaticMap::load(&config, dir.path(), true).unwrap();
        assert!(problems.len() == 1 && problems[0].to_string().contains(name.file_name().unwrap().to_str().unwrap()));
        assert!(rest.len() < whole && rest.len() > whole / 2 && !rest.cloud().unwrap().is_empty());
    }
    std::fs::remove_file(&name).unwrap();
    assert!(StaticMap::load(&config, dir.path(), false).is_err());
    let index = dir.path().join("map.index");
    let bytes = std::fs::read(&index).unwrap();
    std::fs::write(&index, &bytes[..bytes.len() - 3]).unwrap();
    assert!(StaticMap::load(&config, dir.path(), true).unwrap_err().to_string().contains("map.index"));
    let other = MapConfig { voxel_m: 0.2, ..config };
    std::fs::write(&index, &bytes).unwrap();
    assert!(StaticMap::load(&other, dir.path(), true).unwrap_err().to_string().contains("map.voxel_m"));
}

#[test]
fn a_disk_that_refuses_is_counted_and_nothing_is_lost_or_broken() {
    let dir = tempfile::tempdir().unwrap();
    let folder = dir.path().join("map");
    let small = MapConfig { max_gaussians: 15_000, max_depth_m: 30.0, ..MapConfig::default() };
    let mut map = StaticMap::in_folder(&small, &folder).unwrap();
    drive(&mut map, 0..8);
    map.save().unwrap();
    let saved = map.cloud().unwrap();
    // The folder's place is taken by a file: every write fails, as on a full disk.
    let aside = dir.path().join("aside");
    std::fs::rename(&folder, &aside).unwrap();
    std::fs::write(&folder, b"in the way").unwrap();
    drive(&mut map, 8..16);
    let c = map.counts();
    assert!(c.spill_failed > 0 && c.evicted > 0 && map.loaded() <= 15_000, "{c:?}");
    assert!(map.save().is_err());
    check(&map);
    std::fs::remove_file(&folder).unwrap();
    std::fs::rename(&aside, &folder).unwrap();
    assert_eq!(StaticMap::load(&small, &folder, false).unwrap().0.cloud().unwrap(), saved, "the last save is whole");
}

#[test]
fn only_what_changed_is_handed_out() {
    let mut map = StaticMap::new(&MapConfig::default());
    drive(&mut map, 0..4);
    let seen = map.revision();
    let everything = map.changed_since(0).unwrap();
    assert_eq!(everything.iter().map(|(_, c)| c.len()).sum::<usize>(), map.len());
    assert!(map.changed_since(seen).unwrap().is_empty());
    drive(&mut map, 50..51);
    let fresh = map.changed_since(seen).unwrap();
    assert!(!fresh.is_empty() && fresh.iter().all(|(i, _)| i[0] > 55), "only around 1000 m");
    // A listener that applies what changed holds the map.
    let mut held: std::collections::BTreeMap<_, _> = everything.into_iter().collect();
    held.extend(fresh);
    let all: std::collections::BTreeMap<_, _> = map.changed_since(0).unwrap().into_iter().collect();
    assert_eq!(held, all);
}

#[test]
fn whoever_takes_the_news_in_pieces_holds_the_map() {
    let dir = tempfile::tempdir().unwrap();
    let mut map = StaticMap::in_folder(&MapConfig::default(), dir.path()).unwrap();
    let mut news = TileNews::default();
    let mut held = std::collections::BTreeMap::new();
    let mut take = |news: &mut TileNews, map: &StaticMap, most: usize| {
        let tiles = news.take(map, most).unwrap();
        let rows: usize = tiles.iter().map(|(_, c)| c.len()).sum();
        assert!(rows <= most || tiles.len() == 1, "{rows} in {} tiles, limit {most}", tiles.len());
        let any = !tiles.is_empty();
        held.extend(tiles);
        held.retain(|_, c| !c.is_empty());
        any
    };
    for from in [0, 4, 8, 12] {
        drive(&mut map, from..from + 4);
        take(&mut news, &map, 500);
    }
    assert!(take(&mut news, &map, 500), "a small limit leaves something for later");
    while take(&mut news, &map, 500) {}
    // Another map in its place: what the old one had elsewhere has to go.
    let mut other = StaticMap::new(&MapConfig::default());
    drive(&mut other, 3..5);
    news.forget();
    while take(&mut news, &other, 500) {}
    let all: std::collections::BTreeMap<_, _> = other.changed_since(0).unwrap().into_iter().collect();
    assert_eq!(held.keys().collect::<Vec<_>>(), all.keys().collect::<Vec<_>>());
    assert!(held.values().zip(all.values()).all(|(a, b)| a.positions == b.positions && a.opacities == b.opacities));
}

#[test]
fn a_late_loop_closure_moves_tiles_and_brings_two_passes_together() {
    let dir = tempfile::tempdir().unwrap();
    let mut map = StaticMap::in_folder(&MapConfig::default(), dir.path()).unwrap();
    let (g, k) = wall(64, 10.0, |_| 0.0);
    let at = |drift: f64| DVec3::new(0.3, drift, 0.2);
    // The second pass has drifted by 60 m to the side and 1 degree round.
    look(&mut map, 0, at(0.0), &g, &k);
    let one_pass = map.len();
    map.save().unwrap();
    look(&mut map, 600_000, at(60.0), &g, &k);
    assert_eq!(map.len(), 2 * one_pass);
    let correction = |stamp_ms: i64, old: f64, new: f64| PoseCorrection {
        stamp_ns: stamp_ms * 1_000_000,
        old_map_from_anchor: Rigid::new(DQuat::IDENTITY, at(old)),
        new_map_from_anchor: Rigid::new(DQuat::IDENTITY, at(new)),
    };
    assert_eq!(map.correct(&[]).unwrap(), 0);
    let seen = map.revision();
    let moved = map.correct(&[correction(0, 0.0, 0.0), correction(600_000, 60.0, 0.0)]).unwrap();
    assert!(moved > 0);
    check(&map);
    assert!(map.len() <= one_pass + one_pass / 50, "{one_pass}, after {}", map.len());
    let c = map.cloud().unwrap();
    assert!(c.positions.iter().all(|p| p[1].abs() < 11.0 && (p[0] - 10.0).abs() < 0.01));
    let left: usize = map.changed_since(seen).unwrap().iter().filter(|(i, _)| i[1] > 2).map(|(_, c)| c.len()).sum();
    assert_eq!(left, 0, "listeners hear that the old place is empty");
    map.save().unwrap();
    let (loaded, _) = StaticMap::load(&MapConfig::default(), dir.path(), false).unwrap();
    assert_eq!(loaded.cloud().unwrap(), c);
}

#[test]
fn a_map_that_broke_off_in_the_middle_is_made_whole() {
    let mut map = StaticMap::new(&MapConfig::default());
    drive(&mut map, 0..3);
    let whole = map.cloud().unwrap();
    map.recover();
    check(&map);
    assert_eq!(map.cloud().unwrap(), whole, "nothing was broken and nothing is lost");
    // A cell half written, one that is there twice, and an index that was being rebuilt.
    map.tiles[0].cells[0].position.x = f32::NAN;
    let twin = map.tiles[1].cells[0];
    map.tiles[1].cells.push(twin);
    map.by_index.clear();
    map.recover();
    check(&map);
    assert_eq!(map.len(), whole.len() - 1);
    assert_eq!(map.counts().tiles_lost, 0);
    drive(&mut map, 3..5);
    check(&map);
}

#[test]
fn an_index_with_sizes_no_map_has_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let mut map = StaticMap::in_folder(&MapConfig::default(), dir.path()).unwrap();
    drive(&mut map, 0..1);
    map.save().unwrap();
    for (tile_m, voxel_m) in [(16.0, 1e190), (1e300, 1e299), (16.0, 1e-9), (f64::NAN, 0.1)] {
        let index =
            MapIndex { tile_m, voxel_m, origin: DVec3::ZERO, revision: 1, first_stamp_ns: 0, entries: Vec::new() };
        std::fs::write(dir.path().join("map.index"), super::super::format::encode_index(&index)).unwrap();
        assert!(StaticMap::open(dir.path(), true).is_err(), "{tile_m} {voxel_m}");
    }
}
