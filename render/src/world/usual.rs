//! The usual look keeps its bytes.

use crate::world::{Drive, DriveOptions, WorldFrame};

/// FNV-1a over everything a frame holds.
fn hash(frame: &WorldFrame) -> u64 {
    let mut h = 0xcbf2_9ce4_8422_2325u64;
    let mut eat = |bytes: &[u8]| bytes.iter().for_each(|&b| h = (h ^ u64::from(b)).wrapping_mul(0x100_0000_01b3));
    eat(&frame.rgb);
    frame.depth.iter().chain(frame.flow.iter().flatten()).for_each(|x| eat(&x.to_bits().to_le_bytes()));
    frame.instance.iter().for_each(|x| eat(&x.to_le_bytes()));
    eat(&frame.sky);
    eat(&frame.moving);
    h
}

/// The held-out suite, the demo and synthesised bags keep their images: figures of earlier versions stay comparable. Sines
/// and powers come from the platform's mathematics library, so the bytes are those of one platform.
#[test]
fn the_usual_look_keeps_its_bytes() {
    let at = |seed: u64, cameras: usize, zoom: [f32; 2], time: f64| {
        let options = DriveOptions { seed, cameras, zoom, seconds: 8.0, width: 96, height: 64, ..Default::default() };
        let drive = Drive::new(&options).unwrap();
        (0..cameras).fold(0u64, |h, c| h.rotate_left(9) ^ hash(&drive.render(c, time)))
    };
    let seen = [
        at(0, 3, [1.0; 2], 0.0),
        at(10_000, 3, [1.0; 2], 1.5),
        at(10_007, 3, [1.0; 2], 0.3),
        at(20_001, 2, [1.0; 2], 4.0),
        at(7, 1, [0.6, 1.2], 2.2),
        at(30_003, 6, [1.0; 2], 6.1),
    ];
    assert_eq!(
        seen,
        [
            0x5fd8_21fe_c78b_4491,
            0xc45a_1355_eb61_05d1,
            0x9f3a_d43e_89a6_8091,
            0x05e2_2a61_ab5f_8c80,
            0x7c47_8809_6dfd_c097,
            0x743e_ec90_7873_a090
        ],
        "{seen:#x?}"
    );
}
