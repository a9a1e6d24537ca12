use std::path::PathBuf;

use candle_core::{DType, Device};
use proptest::prelude::*;

use super::*;
use crate::config::{SkyKind, VelocityKind};
use crate::network::Storm;

fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../tests/fixtures/pth").join(name)
}

fn small() -> ModelConfig {
    ModelConfig {
        embed_dim: 16,
        depth: 1,
        num_heads: 2,
        patch_size: 4,
        image_height: 8,
        image_width: 12,
        upsampler_widths: vec![6, 4],
        num_motion_tokens: 2,
        sky: SkyKind::Frequency64,
        ..ModelConfig::default()
    }
}

fn values(x: &Tensor) -> Vec<f32> {
    assert_eq!(x.dtype(), DType::F32);
    x.flatten_all().unwrap().to_vec1().unwrap()
}

fn message(error: ModelError) -> String {
    error.to_string()
}

/// What `make_pth.py` puts into a tensor.
fn expected(name: &str, count: usize) -> Vec<f32> {
    if name == "max_scale" {
        return vec![0.5];
    }
    (0..count).map(|i| (((i + name.len()) % 17) as f32 - 8.0) / 16.0).collect()
}

#[test]
fn both_kinds_of_checkpoint_read_with_every_value() {
    for file in ["plain.pth", "training.pth"] {
        let (config, tensors) = load(&fixture(file), None, &Device::Cpu).unwrap();
        assert_eq!((config.embed_dim, config.depth, config.num_heads, config.patch_size), (16, 1, 1, 4));
        assert_eq!((config.image_height, config.image_width), (8, 12), "from plucker_embedder.x");
        assert_eq!((config.num_cams, config.num_motion_tokens, config.projected_motion_dim), (2, 2, 4));
        assert_eq!((config.key_hidden, config.basis_hidden, &config.upsampler_widths[..]), (10, 12, &[8, 6][..]));
        assert_eq!((config.sky, config.velocity), (SkyKind::Frequency64, VelocityKind::One));
        assert_eq!(tensors.len(), tensor_specs(&config).len());
        for (name, tensor) in &tensors {
            assert_eq!(values(tensor), expected(name, tensor.elem_count()), "{file}: {name}");
        }
        Storm::new(&config, &tensors).unwrap();
    }
}

#[test]
fn saved_weights_come_back_and_bytes_repeat() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (folder.path().join("a.safetensors"), folder.path().join("b.safetensors"));
    let config = small();
    let tensors = untrained(&config, 7, &Device::Cpu).unwrap();
    for dtype in [SavedType::F32, SavedType::F16] {
        for path in [&a, &b] {
            save_safetensors(path, &config, &tensors, dtype, "a test").unwrap();
        }
        assert_eq!(std::fs::read(&a).unwrap(), std::fs::read(&b).unwrap());
        let (read_config, read) = load(&a, None, &Device::Cpu).unwrap();
        assert_eq!(read_config, config);
        for (name, tensor) in &tensors {
            let half = |x: f32| if name == "max_scale" { x } else { half::f16::from_f32(x).to_f32() };
            let want: Vec<f32> = match dtype {
                SavedType::F32 => values(tensor),
                SavedType::F16 => values(tensor).into_iter().map(half).collect(),
            };
            assert_eq!(values(&read[name]), want, "{name}");
        }
    }
    let left: Vec<_> = std::fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 2, "no temporary file stays: {left:?}");
}

#[test]
fn differences_are_named_with_both_shapes() {
    let config = small();
    let mut tensors = untrained(&config, 1, &Device::Cpu).unwrap();
    let bias = tensors.remove("norm.bias").unwrap();
    tensors.insert("norm.offset".into(), bias.clone());
    tensors.insert("gs_pred.bias".into(), bias);
    let error = message(Storm::new(&config, &tensors).unwrap_err());
    for part in ["missing: norm.bias", "not in the network: norm.offset", "gs_pred.bias is [16], expected [192]"] {
        assert!(error.contains(part), "{error}");
    }
    let latent = [("decoder.mask_token", &[512usize][..])];
    assert!(check_shapes(&config, latent.into_iter()).unwrap_err().to_string().contains("Latent-STORM"));
    let wrong = ModelConfig { num_motion_tokens: 4, ..small() };
    let error = message(load(&fixture("plain.pth"), Some(&wrong), &Device::Cpu).unwrap_err());
    assert!(error.contains("motion_query_heads.3"), "{error}");
}

#[test]
fn untrained_weights_depend_on_the_seed_only() {
    let config = small();
    let all =
        |seed| -> Vec<Vec<f32>> { untrained(&config, seed, &Device::Cpu).unwrap().values().map(values).collect() };
    assert_eq!(all(3), all(3));
    assert_ne!(all(3), all(4));
}

#[test]
fn a_broken_max_scale_or_value_is_refused() {
    let config = small();
    let mut tensors = untrained(&config, 1, &Device::Cpu).unwrap();
    let path = tempfile::tempdir().unwrap().path().join("never.safetensors");
    tensors.insert("norm.bias".into(), Tensor::full(f32::NAN, 16, &Device::Cpu).unwrap());
    let error = message(save_safetensors(&path, &config, &tensors, SavedType::F32, "").unwrap_err());
    assert!(error.contains("norm.bias") && error.contains("16"), "{error}");
    tensors.insert("max_scale".into(), Tensor::new(&[f32::NAN], &Device::Cpu).unwrap());
    assert!(message(Storm::new(&config, &tensors).unwrap_err()).contains("max_scale"));
}

#[test]
fn other_files_are_refused_with_the_reason() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, bytes: &[u8]| {
        let path = folder.path().join(name);
        std::fs::write(&path, bytes).unwrap();
        path
    };
    let read = |path: &Path| message(load(path, None, &Device::Cpu).unwrap_err());
    assert!(read(&write("old.pth", b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.")).contains("old format"));
    assert!(read(&write("old", b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19.")).contains("old format"));
    assert!(read(&write("text.pth", b"hello world, this is text")).contains("neither"));
    assert!(read(&write("empty.safetensors", b"")).contains("neither"));
    assert!(read(&write("zip.pth", b"PK\x03\x04 and nothing")).contains("zip"));
    assert!(read(&folder.path().join("absent.pth")).contains("absent.pth"));
    // 100 GB claimed by a header of 100 bytes.
    let mut header =
        br#"{"norm.weight":{"dtype":"F32","shape":[25000000000],"data_offsets":[0,100000000000]}}"#.to_vec();
    header.resize(96, b' ');
    let file = [&96u64.to_le_bytes()[..], &header].concat();
    assert!(read(&write("large.safetensors", &file)).contains("not valid safetensors"));
    let unknown =
        br#"{"__metadata__":{"storm_config":"{\"patches\":3}"},"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}}"#;
    let file = [&(unknown.len() as u64).to_le_bytes()[..], unknown, &[0; 4]].concat();
    assert!(read(&write("config.safetensors", &file)).contains("patches"));
}

#[test]
fn cut_and_damaged_checkpoints_never_panic() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("damaged.pth");
    let whole = std::fs::read(fixture("training.pth")).unwrap();
    for k in 1..40 {
        std::fs::write(&path, &whole[..whole.len() * k / 40]).unwrap();
        assert!(load(&path, None, &Device::Cpu).is_err(), "cut at {k}/40");
    }
    // Flipped bytes in the pickle, which comes first: refused, or read as other numbers, but never a crash.
    let mut changed = 0;
    for at in (0..whole.len().min(24_000)).step_by(37) {
        let mut bytes = whole.clone();
        bytes[at] ^= 0x5a;
        std::fs::write(&path, &bytes).unwrap();
        changed += usize::from(load(&path, None, &Device::Cpu).is_err());
    }
    assert!(changed > 100, "only {changed} of the damages were noticed");
}

proptest! {
    #[test]
    fn claimed_shapes_never_panic_or_allocate(
        name in 0usize..1000,
        shape in prop::collection::vec(prop::sample::select(vec![0usize, 1, 2, 3, 8, 64, 1 << 20, 1 << 40, usize::MAX]), 0..5),
    ) {
        let specs = tensor_specs(&small());
        let spoiled = specs[name % specs.len()].name.clone();
        let mut shapes: BTreeMap<_, _> = specs.into_iter().map(|s| (s.name, s.shape)).collect();
        shapes.insert(spoiled, shape);
        if let Ok(config) = infer_config(&shapes, None) && config.validate().is_ok() {
            let _ = check_shapes(&config, shapes.iter().map(|(name, s)| (name.as_str(), &s[..])));
        }
    }
}

#[test]
fn authors_checkpoint_shapes_give_the_preset_back() {
    for name in ["b8", "l8", "xl8", "h8", "b16", "l16", "xl16", "h16"] {
        let config = ModelConfig::preset(name).unwrap();
        let shapes = tensor_specs(&config).into_iter().map(|s| (s.name, s.shape)).collect();
        assert_eq!(infer_config(&shapes, None).unwrap(), config, "{name}");
    }
    let no_motion = ModelConfig { num_motion_tokens: 0, use_affine_token: false, ..ModelConfig::default() };
    let shapes = tensor_specs(&no_motion).into_iter().map(|s| (s.name, s.shape)).collect();
    assert_eq!(infer_config(&shapes, None).unwrap(), no_motion);
}
