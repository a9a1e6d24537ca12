//! The network against the authors' program, stage by stage, on the tiny weights stored in `tests/fixtures/tiny_storm`.
#![allow(clippy::unwrap_used)]

mod golden;

use golden::{Checker, run, storm, values};

#[test]
fn every_stage_agrees() {
    let (output, stages) = run();
    let mut checker = Checker::new();
    let stage = |name: &str| stages.get(name).unwrap_or_else(|| panic!("stage {name} was not kept"));

    checker.check("ray_dirs", "ray_dirs", &values(stage("ray_directions")));
    // (t v, 6, h, w) -> timesteps 0 and 3, channel last.
    let plucker = stage("plucker").permute((0, 2, 3, 1)).unwrap();
    let picked = [values(&plucker.narrow(0, 0, 3).unwrap()), values(&plucker.narrow(0, 9, 3).unwrap())].concat();
    checker.check("plucker_t0t3", "plucker", &picked);
    for name in ["patch_embed", "time_freq", "time_embed", "tokens_in", "block_0", "block_1", "tokens_norm"] {
        checker.check(name, name, &values(stage(name)));
    }
    for name in ["block_0.norm1", "block_0.attn", "block_0.norm2", "block_0.mlp"] {
        checker.check(name, name, &values(stage(name)));
    }
    let qkv = stage("block_0.attn.qkv").narrow(1, 0, 64).unwrap();
    checker.check("block_0.attn.qkv", "block_0.attn.qkv", &values(&qkv));

    // Image t=0, v=1 is the second of 15 patches each.
    let raw = stage("gs_pred_raw").narrow(1, 15, 15).unwrap();
    checker.check("gs_pred_raw_t0v1", "gs_pred_raw", &values(&raw));
    for layer in 0..9 {
        let chw = stage(&format!("upscaling_{layer}")).permute((2, 0, 1)).unwrap().narrow(0, 0, 16).unwrap();
        checker.check(&format!("upscaling_{layer}_t0v1_c16"), &format!("upscaling_{layer}"), &values(&chw));
    }
    checker.check("motion_keys_t0v1", "motion_keys", &values(stage("motion_keys")));
    checker.check("motion_queries", "motion_queries", &values(stage("motion_queries")));

    let outputs = [
        ("depths", &output.depths),
        ("means", &output.means),
        ("scales", &output.scales),
        ("quats", &output.quats),
        ("opacities", &output.opacities),
        ("colors", &output.colors),
        ("forward_flow", &output.velocity_forward),
        ("motion_bases", output.motion_bases.as_ref().unwrap()),
        ("affine", output.affine.as_ref().unwrap()),
    ];
    for (name, tensor) in outputs {
        checker.check(name, name, &values(tensor));
    }
    let weights = output.motion_weights.as_ref().unwrap().narrow(1, 3, 1).unwrap();
    checker.check("motion_weights_t3", "motion_weights", &values(&weights));
    assert_eq!(checker.checked, 36);
    checker.finish();
}

#[test]
fn position_embedding_resamples_as_theirs() {
    let storm = storm();
    let mut checker = Checker::new();
    // No floor of its own; it is the first term of tokens_in.
    let tolerance = checker.tolerance("tokens_in");
    for (rows, cols) in [(3, 5), (6, 9), (2, 3)] {
        let ours = storm.position_embedding(rows, cols).unwrap().unwrap();
        checker.check_where(&format!("posembed_{rows}x{cols}"), tolerance, &values(&ours), |_| true);
    }
    checker.finish();
}
