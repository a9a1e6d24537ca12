// Times the CPU rasteriser of OpenSplat (forward, one view) on a scene that `raster_bench` wrote.
//
//   peer SCENE REPEATS PICTURE
//
// SCENE: "STORMSP1", then u32 n, width, height; f32 fx, fy, cx, cy; f32 means 3n (camera frame), quats 4n (wxyz), scales
// 3n, opacities n, colours 3n. PICTURE gets the last picture as f32 rgb. Prints one line of JSON: milliseconds of every
// repeat (projection, sort, blending), and the threads PyTorch uses. OpenSplat's own sources are not part of this
// program; build.sh compiles the rasteriser from where they are.
#include "gsplat-cpu/bindings.h"

#include <chrono>
#include <cstdint>
#include <cstring>
#include <fstream>
#include <vector>

static torch::Tensor read(std::ifstream &in, std::vector<int64_t> shape) {
    auto tensor = torch::empty(shape, torch::kFloat32);
    in.read(static_cast<char *>(tensor.data_ptr()), tensor.numel() * 4);
    return tensor;
}

int main(int argc, char **argv) {
    if (argc != 4) {
        std::cerr << "peer SCENE REPEATS PICTURE\n";
        return 1;
    }
    torch::NoGradGuard no_grad;
    std::ifstream in(argv[1], std::ios::binary);
    char magic[8];
    uint32_t head[3];
    float k[4];
    in.read(magic, 8);
    in.read(reinterpret_cast<char *>(head), sizeof head);
    in.read(reinterpret_cast<char *>(k), sizeof k);
    if (!in || std::memcmp(magic, "STORMSP1", 8) != 0) {
        std::cerr << argv[1] << " is not a scene of storm bench\n";
        return 2;
    }
    const int64_t n = head[0];
    const int width = static_cast<int>(head[1]), height = static_cast<int>(head[2]);
    auto means = read(in, {n, 3}), quats = read(in, {n, 4}), scales = read(in, {n, 3});
    auto opacities = read(in, {n, 1}), colors = read(in, {n, 3});
    if (!in) {
        std::cerr << argv[1] << " ends early\n";
        return 2;
    }
    const float fx = k[0], fy = k[1], cx = k[2], cy = k[3], near = 0.2f, far = 400.0f;
    auto view = torch::eye(4);
    // Row 0 and 1 give u and v of OpenSplat, whose pixel centres are whole numbers.
    auto projection = torch::tensor({{2 * fx / width, 0.f, 2 * cx / width - 1, 0.f},
                                     {0.f, 2 * fy / height, 2 * cy / height - 1, 0.f},
                                     {0.f, 0.f, (far + near) / (far - near), -2 * far * near / (far - near)},
                                     {0.f, 0.f, 1.f, 0.f}});
    auto background = torch::zeros({3});
    torch::Tensor picture;
    std::cout << "{\"threads\": " << torch::get_num_threads() << ", \"ms\": [";
    const int repeats = std::atoi(argv[2]);
    for (int repeat = 0; repeat <= repeats; repeat++) {
        const auto start = std::chrono::steady_clock::now();
        auto [xys, radii, conics, cov2d, depths] = project_gaussians_forward_tensor_cpu(
            static_cast<int>(n), means, scales, 1.0f, quats, view, projection, fx, fy, cx, cy, height, width, near);
        auto contiguous = depths.contiguous();
        auto [image, transmittance, lists] = rasterize_forward_tensor_cpu(
            width, height, xys, conics, colors, opacities, background, cov2d, contiguous);
        const std::chrono::duration<double, std::milli> took = std::chrono::steady_clock::now() - start;
        delete[] lists;
        picture = image;
        // The first one warms up.
        if (repeat > 0) std::cout << (repeat > 1 ? ", " : "") << took.count();
    }
    std::cout << "]}" << std::endl;
    std::ofstream(argv[3], std::ios::binary).write(static_cast<char *>(picture.data_ptr()), picture.numel() * 4);
}
