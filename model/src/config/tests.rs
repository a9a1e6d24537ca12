use super::*;
use crate::error::ModelError;

#[test]
fn presets_are_valid_and_read_back_the_same() {
    for name in ["tiny", "base", "b8", "l8", "xl8", "h8", "b16", "l16", "xl16", "h16", "STORM-B/8"] {
        let authors = ModelConfig::preset(name).unwrap();
        for config in [authors.clone(), authors.with_paper_choices()] {
            config.validate().unwrap();
            let text = serde_json::to_string(&config).unwrap();
            assert_eq!(serde_json::from_str::<ModelConfig>(&text).unwrap(), config);
        }
    }
    assert_eq!(ModelConfig::preset("storm-b/8").unwrap(), ModelConfig::default());
}

#[test]
fn paper_choices_differ_where_the_paper_does() {
    let paper = ModelConfig::preset("b8").unwrap().with_paper_choices();
    assert_eq!(paper.near, 0.1);
    assert_eq!(paper.velocity_channels(), 6);
    assert_eq!(paper.depth_meaning, DepthMeaning::RayDistance);
    assert_eq!(paper.embed_dim, 768);
}

#[test]
fn unknown_names_and_fields_are_refused() {
    for name in ["", "8", "b32", "x8", "huge"] {
        assert!(matches!(ModelConfig::preset(name), Err(ModelError::UnknownPreset { .. })), "{name}");
    }
    let error = serde_json::from_str::<ModelConfig>(r#"{"patchsize": 8}"#).unwrap_err().to_string();
    assert!(error.contains("patchsize"), "{error}");
    assert!(serde_json::from_str::<ModelConfig>(r#"{"velocity": "two"}"#).is_err());
}

#[test]
fn every_bad_value_is_named() {
    type Spoil = fn(&mut ModelConfig);
    let cases: [(&str, Spoil); 17] = [
        ("patch_size", |c| c.patch_size = 12),
        ("num_heads", |c| c.num_heads = 7),
        ("image_width", |c| c.image_width = 100),
        ("sweep_after_block", |c| c.sweep_after_block = c.depth),
        ("num_cams", |c| c.num_cams = 7),
        ("depth", |c| c.depth = 0),
        ("upsampler_widths", |c| c.upsampler_widths = vec![]),
        ("upsampler_widths", |c| c.upsampler_widths = vec![8; 4]),
        ("tau", |c| c.tau = 0.0),
        ("tau", |c| c.tau = f64::NAN),
        ("far", |c| c.far = c.near),
        ("max_scale", |c| c.max_scale = f64::INFINITY),
        ("flow_gate_mps", |c| c.flow_gate_mps = -1.0),
        ("time_fade_sec", |c| c.time_fade_sec = f64::NAN),
        ("screen_blur_px2", |c| c.screen_blur_px2 = -0.1),
        ("screen_blur_px2", |c| c.screen_blur_px2 = f64::NAN),
        ("embed_dim", |c| c.embed_dim = usize::MAX),
    ];
    for (field, spoil) in cases {
        let mut config = ModelConfig::default();
        spoil(&mut config);
        let error = config.validate().unwrap_err().to_string();
        assert!(error.contains(field), "{field}: {error}");
    }
}

#[test]
fn spread_bases_cancel_and_differ() {
    for count in [0, 1, 2, 4, 8, 16, 31, 32] {
        let bases = spread_bases(count);
        assert_eq!(bases.len(), count);
        for axis in 0..3 {
            assert_eq!(bases.iter().map(|b| b[axis]).sum::<f32>(), 0.0, "{count} bases");
        }
        let zeros = bases.iter().filter(|b| **b == [0.0; 3]).count();
        assert_eq!(zeros, if count == 0 { 0 } else { 1 + (count + 1) % 2 });
        for (i, a) in bases.iter().enumerate() {
            assert!(*a == [0.0; 3] || bases[..i].iter().all(|b| a != b), "{count} bases: {a:?} stands twice");
        }
    }
}
