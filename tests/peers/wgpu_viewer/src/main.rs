//! Times wgpu-3dgs-viewer (sort and draw, one view) on a scene that `raster_bench` wrote.
//!
//! `peer-wgpu-viewer SCENE REPEATS PICTURE`. SCENE as in `../opensplat/main.cpp`; PICTURE gets the last picture as f32
//! rgb. Prints one line of JSON: the adapter, and the milliseconds of every repeat from the commands to the finished
//! picture on the device.

use std::io::Write;
use std::time::Instant;

use glam::{Mat4, Quat, U8Vec4, Vec3, uvec2, vec3};
use wgpu_3dgs_viewer as gs;

type Error = Box<dyn std::error::Error>;

/// A file's numbers, one array after the other.
struct Reader<'a> {
    rest: &'a [u8],
}

impl Reader<'_> {
    fn words<const N: usize>(&mut self) -> Result<[[u8; 4]; N], Error> {
        let (now, rest) = self.rest.split_at_checked(4 * N).ok_or("the scene ends early")?;
        self.rest = rest;
        Ok(std::array::from_fn(|i| [now[4 * i], now[4 * i + 1], now[4 * i + 2], now[4 * i + 3]]))
    }

    fn rows<const N: usize>(&mut self, n: usize) -> Result<Vec<[f32; N]>, Error> {
        (0..n).map(|_| Ok(self.words::<N>()?.map(f32::from_le_bytes))).collect()
    }
}

/// The identity pose: x right, y down, z ahead, while the viewer wants y up and z back.
struct Camera {
    vertical_fov: f32,
}

impl gs::CameraTrait for Camera {
    fn view(&self) -> Mat4 {
        Mat4::from_scale(vec3(1.0, -1.0, -1.0))
    }

    fn projection(&self, aspect_ratio: f32) -> Mat4 {
        glam::camera::rh::proj::directx::perspective(self.vertical_fov, aspect_ratio, 0.2, 400.0)
    }
}

fn main() -> Result<(), Error> {
    let args: Vec<String> = std::env::args().collect();
    let [_, scene, repeats, out] = args.as_slice() else {
        return Err("peer-wgpu-viewer SCENE REPEATS PICTURE".into());
    };
    let bytes = std::fs::read(scene)?;
    let mut file = Reader { rest: bytes.strip_prefix(b"STORMSP1").ok_or("not a scene of raster_bench")? };
    let [n, width, height] = file.words::<3>()?.map(u32::from_le_bytes);
    let [_, fy, ..] = file.words::<4>()?.map(f32::from_le_bytes);
    let count = n as usize;
    let (means, quats) = (file.rows::<3>(count)?, file.rows::<4>(count)?);
    let (scales, opacities, colors) = (file.rows::<3>(count)?, file.rows::<1>(count)?, file.rows::<3>(count)?);
    let byte = |x: f32| (x.clamp(0.0, 1.0) * 255.0).round() as u8;
    let gaussians: Vec<gs::core::Gaussian> = (0..count)
        .map(|i| {
            let [w, x, y, z] = quats[i];
            let [r, g, b] = colors[i].map(byte);
            gs::core::Gaussian {
                rot: Quat::from_xyzw(x, y, z, w).normalize(),
                pos: means[i].into(),
                color: U8Vec4::new(r, g, b, byte(opacities[i][0])),
                sh: [Vec3::ZERO; 15],
                scale: scales[i].into(),
            }
        })
        .collect();

    let instance = wgpu::Instance::new(wgpu::InstanceDescriptor::new_without_display_handle().with_env());
    let adapter = pollster::block_on(instance.request_adapter(&wgpu::RequestAdapterOptions::default()))?;
    let (device, queue) = pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
        required_limits: adapter.limits(),
        ..Default::default()
    }))?;
    let format = wgpu::TextureFormat::Rgba8Unorm;
    let mut viewer = gs::Viewer::<gs::DefaultGaussianPod>::new(&device, format, &gaussians)?;
    let camera = Camera { vertical_fov: 2.0 * (0.5 * height as f32 / fy).atan() };
    viewer.update_camera(&queue, &camera, uvec2(width, height));
    viewer.update_model_transform(&queue, Vec3::ZERO, Quat::IDENTITY, Vec3::ONE);
    viewer.update_gaussian_transform(
        &queue,
        1.0,
        gs::core::GaussianDisplayMode::Splat,
        gs::core::GaussianShDegree::new(0).ok_or("degree")?,
        false,
        gs::core::GaussianMaxStdDev::new(3.0).ok_or("deviations")?,
    );
    let texture = device.create_texture(&wgpu::TextureDescriptor {
        label: None,
        size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
        mip_level_count: 1,
        sample_count: 1,
        dimension: wgpu::TextureDimension::D2,
        format,
        usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
        view_formats: &[],
    });
    let view = texture.create_view(&Default::default());
    let mut times_ms = Vec::new();
    for repeat in 0..=repeats.parse::<usize>()? {
        let start = Instant::now();
        let mut encoder = device.create_command_encoder(&Default::default());
        viewer.render(&mut encoder, &view);
        queue.submit([encoder.finish()]);
        device.poll(wgpu::PollType::wait_indefinitely())?;
        // The first one compiles the pipelines.
        if repeat > 0 {
            times_ms.push(start.elapsed().as_secs_f64() * 1e3);
        }
    }
    println!("{}", serde_json::json!({"adapter": adapter.get_info().name, "ms": times_ms}));

    let row = (4 * width).next_multiple_of(wgpu::COPY_BYTES_PER_ROW_ALIGNMENT);
    let buffer = device.create_buffer(&wgpu::BufferDescriptor {
        label: None,
        size: u64::from(row * height),
        usage: wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        mapped_at_creation: false,
    });
    let mut encoder = device.create_command_encoder(&Default::default());
    encoder.copy_texture_to_buffer(
        texture.as_image_copy(),
        wgpu::TexelCopyBufferInfo {
            buffer: &buffer,
            layout: wgpu::TexelCopyBufferLayout { offset: 0, bytes_per_row: Some(row), rows_per_image: None },
        },
        texture.size(),
    );
    queue.submit([encoder.finish()]);
    buffer.map_async(wgpu::MapMode::Read, .., |_| {});
    device.poll(wgpu::PollType::wait_indefinitely())?;
    let mapped = buffer.get_mapped_range(..)?;
    let mut picture = Vec::new();
    for line in mapped.chunks_exact(row as usize) {
        for pixel in line[..4 * width as usize].chunks_exact(4) {
            pixel[..3].iter().for_each(|&x| picture.extend_from_slice(&(f32::from(x) / 255.0).to_le_bytes()));
        }
    }
    std::fs::File::create(out)?.write_all(&picture)?;
    Ok(())
}
