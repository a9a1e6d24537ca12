"""Times a PyTorch forward pass of the same shapes as `storm bench`: the peer our network is compared with.

    python peer_network.py [--embed 768 --depth 12 --heads 12 --height 160 --width 240 --views 12 --runs 3]
                           [--bf16] [--compile]

Random weights; images to Gaussians, velocities and motion weights (no rendering), all cores; fp32, or bf16 by autocast;
eager, or by torch.compile (which wants a C++ compiler; what it takes to compile is not counted).
Prints one JSON line: seconds per run and peak memory.
"""
import argparse
import json
import time

import torch
import torch.nn.functional as F

MOTION_TOKENS, MOTION_DIM, GAUSSIAN_CHANNELS, EXTRA_TOKENS = 16, 32, 12, 20


class Block(torch.nn.Module):
    def __init__(self, dim, heads):
        super().__init__()
        self.heads = heads
        self.norm1, self.norm2 = torch.nn.LayerNorm(dim, eps=1e-6), torch.nn.LayerNorm(dim, eps=1e-6)
        self.qkv, self.proj = torch.nn.Linear(dim, 3 * dim), torch.nn.Linear(dim, dim)
        self.fc1, self.fc2 = torch.nn.Linear(dim, 4 * dim), torch.nn.Linear(4 * dim, dim)

    def forward(self, x):
        b, n, d = x.shape
        q, k, v = self.qkv(self.norm1(x)).reshape(b, n, 3, self.heads, -1).permute(2, 0, 3, 1, 4)
        x = x + self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, n, d))
        return x + self.fc2(F.gelu(self.fc1(self.norm2(x))))


class Norm2d(torch.nn.Module):
    def __init__(self, channels):
        super().__init__()
        self.weight, self.bias = (torch.nn.Parameter(f(channels)) for f in (torch.ones, torch.zeros))

    def forward(self, x):
        mean = x.mean(1, keepdim=True)
        x = (x - mean) / ((x - mean).pow(2).mean(1, keepdim=True) + 1e-6).sqrt()
        return x * self.weight[:, None, None] + self.bias[:, None, None]


def peak_kib():
    """Of this program alone: what getrusage says begins with what its parent had when it was started."""
    with open("/proc/self/status") as status:
        return next(int(line.split()[1]) for line in status if line.startswith("VmHWM"))


def main():
    p = argparse.ArgumentParser()
    for name, value in dict(embed=768, depth=12, heads=12, height=160, width=240, views=12, runs=3).items():
        p.add_argument(f"--{name}", type=int, default=value)
    p.add_argument("--bf16", action="store_true")
    p.add_argument("--compile", action="store_true")
    a = p.parse_args()
    torch.manual_seed(0)
    grid = (a.height // 8, a.width // 8)
    patch = torch.nn.Conv2d(9, a.embed, 8, 8)
    blocks = torch.nn.Sequential(*[Block(a.embed, a.heads) for _ in range(a.depth)])
    norm, gaussians = torch.nn.LayerNorm(a.embed), torch.nn.Linear(a.embed, 64 * GAUSSIAN_CHANNELS)
    widths = [a.embed, 512, 256, 128]
    up = torch.nn.Sequential(*[
        m for i in range(3)
        for m in (torch.nn.ConvTranspose2d(widths[i], widths[i + 1], 2, 2), Norm2d(widths[i + 1]), torch.nn.GELU())
    ])
    key = torch.nn.Sequential(torch.nn.Linear(128, 256), torch.nn.GELU(), torch.nn.Linear(256, MOTION_DIM))
    queries, bases = torch.randn(MOTION_TOKENS, MOTION_DIM), torch.randn(MOTION_TOKENS, 3)
    image = torch.randn(a.views, 9, a.height, a.width)

    def forward():
        tokens = patch(image).flatten(2).transpose(1, 2).reshape(1, -1, a.embed)
        tokens = torch.cat([torch.zeros(1, EXTRA_TOKENS, a.embed, dtype=tokens.dtype), tokens], 1)
        tokens = norm(blocks(tokens))[:, EXTRA_TOKENS:].reshape(a.views, -1, a.embed)
        features = up(tokens.transpose(1, 2).reshape(a.views, a.embed, *grid)).permute(0, 2, 3, 1)
        weights = torch.softmax((key(features) @ queries.T).float() / 0.5, -1)
        return gaussians(tokens), weights @ bases

    times = []
    with torch.inference_mode(), torch.autocast("cpu", dtype=torch.bfloat16, enabled=a.bf16):
        if a.compile:
            forward = torch.compile(forward)
            forward()
        for _ in range(a.runs):
            start = time.perf_counter()
            forward()
            times.append(time.perf_counter() - start)
    peak_mb = peak_kib() / 1024
    print(json.dumps({"torch": torch.__version__, "threads": torch.get_num_threads(), "bf16": a.bf16, "compiled": a.compile, "seconds": times, "peak_rss_mb": peak_mb}))


if __name__ == "__main__":
    main()
