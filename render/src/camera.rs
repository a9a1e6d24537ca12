//! Pinhole cameras: intrinsics in pixels and the pose a picture is taken from.

use glam::{Affine3A, Mat3A, Vec3, Vec3A};

/// Pinhole intrinsics in pixels of the picture they belong to; the centre of pixel `(col, row)` is `(col + 0.5, row + 0.5)`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Intrinsics {
    /// Focal length along x, pixels.
    pub fx: f32,
    /// Focal length along y, pixels.
    pub fy: f32,
    /// Principal point, x, pixels.
    pub cx: f32,
    /// Principal point, y, pixels.
    pub cy: f32,
    /// Picture width, pixels.
    pub width: usize,
    /// Picture height, pixels.
    pub height: usize,
}

impl Intrinsics {
    /// The same camera with its picture resized to `width` x `height` (each axis scaled on its own).
    pub fn resized(&self, width: usize, height: usize) -> Self {
        let sx = width as f32 / self.width as f32;
        let sy = height as f32 / self.height as f32;
        Self { fx: self.fx * sx, fy: self.fy * sy, cx: self.cx * sx, cy: self.cy * sy, width, height }
    }

    /// A camera with a horizontal field of view of `fov_deg` degrees and a centred principal point.
    pub fn from_fov(fov_deg: f32, width: usize, height: usize) -> Self {
        let fx = 0.5 * width as f32 / (0.5 * fov_deg.to_radians()).tan();
        Self { fx, fy: fx, cx: 0.5 * width as f32, cy: 0.5 * height as f32, width, height }
    }

    /// Direction of picture point `(u, v)` in the optical frame (x right, y down, z forward), with z = 1.
    pub fn ray(&self, u: f32, v: f32) -> Vec3 {
        Vec3::new((u - self.cx) / self.fx, (v - self.cy) / self.fy, 1.0)
    }

    /// Picture point of an optical-frame position; `None` behind the camera plane.
    pub fn project(&self, p: Vec3) -> Option<(f32, f32)> {
        (p.z > 0.0).then(|| (self.fx * p.x / p.z + self.cx, self.fy * p.y / p.z + self.cy))
    }

    /// Row-major 3x3 matrix.
    pub fn matrix(&self) -> [[f32; 3]; 3] {
        [[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]]
    }

    /// True when every number is finite, the focal lengths are positive and the picture has pixels.
    pub fn is_valid(&self) -> bool {
        let finite = [self.fx, self.fy, self.cx, self.cy].iter().all(|x| x.is_finite());
        finite && self.fx > 0.0 && self.fy > 0.0 && self.width > 0 && self.height > 0
    }
}

/// Where a picture is taken from and with which camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct View {
    /// Takes points of the frame the Gaussians live in to the camera's optical frame.
    pub camera_from_world: Affine3A,
    /// The camera.
    pub intrinsics: Intrinsics,
}

impl View {
    /// A view from the camera's own pose, `world_from_camera` (a rigid transform).
    pub fn from_pose(world_from_camera: Affine3A, intrinsics: Intrinsics) -> Self {
        Self { camera_from_world: rigid_inverse(&world_from_camera), intrinsics }
    }

    /// The camera's pose in the world.
    pub fn world_from_camera(&self) -> Affine3A {
        rigid_inverse(&self.camera_from_world)
    }
}

/// Inverse of a rigid transform; exact transposition of the rotation instead of a general inverse.
pub fn rigid_inverse(t: &Affine3A) -> Affine3A {
    let r: Mat3A = t.matrix3.transpose();
    let p: Vec3A = -(r * t.translation);
    Affine3A { matrix3: r, translation: p }
}
