"""Times a PyTorch training step of the same shapes as `cargo run --release -p storm-model --example train_speed`.

    python peer_training.py [--batch 8 --steps 5 --tokens 384 --width 192 --layers 6]

Patches of 8 x 8 pixels with 9 channels, a pre-norm transformer with heads of 32 channels, one linear layer to 12 channels
for each pixel, squared error; fp32, eager, all cores. Prints one JSON line: best wall and processor seconds of forward,
backward and AdamW, and samples per second.
"""
import argparse
import json
import time

import torch
import torch.nn.functional as F

PATCH_INPUTS, PATCH_OUTPUTS, HEAD_DIM = 576, 768, 32


class Block(torch.nn.Module):
    def __init__(self, width):
        super().__init__()
        self.norm1, self.norm2 = torch.nn.LayerNorm(width, eps=1e-6), torch.nn.LayerNorm(width, eps=1e-6)
        self.qkv, self.proj = torch.nn.Linear(width, 3 * width), torch.nn.Linear(width, width)
        self.fc1, self.fc2 = torch.nn.Linear(width, 4 * width), torch.nn.Linear(4 * width, width)

    def forward(self, x):
        b, n, d = x.shape
        q, k, v = self.qkv(self.norm1(x)).reshape(b, n, 3, -1, HEAD_DIM).permute(2, 0, 3, 1, 4)
        x = x + self.proj(F.scaled_dot_product_attention(q, k, v).transpose(1, 2).reshape(b, n, d))
        return x + self.fc2(F.gelu(self.fc1(self.norm2(x))))


def main():
    p = argparse.ArgumentParser()
    for name, value in dict(batch=8, steps=5, tokens=384, width=192, layers=6).items():
        p.add_argument(f"--{name}", type=int, default=value)
    a = p.parse_args()
    torch.manual_seed(0)
    net = torch.nn.Sequential(
        torch.nn.Linear(PATCH_INPUTS, a.width),
        *[Block(a.width) for _ in range(a.layers)],
        torch.nn.LayerNorm(a.width, eps=1e-6),
        torch.nn.Linear(a.width, PATCH_OUTPUTS),
    )
    optimiser = torch.optim.AdamW(net.parameters(), lr=1e-3)
    x = torch.randn(a.batch, a.tokens, PATCH_INPUTS)
    target = torch.randn(a.batch, a.tokens, PATCH_OUTPUTS)
    best, losses = {}, []

    def timed(name, f, count):
        wall, cpu = time.perf_counter(), time.process_time()
        out = f()
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
        if count:
            for key, seconds in ((f"{name}_sec", wall), (f"{name}_cpu_sec", cpu)):
                best[key] = min(best.get(key, seconds), seconds)
        return out

    for step in range(a.steps + 1):
        optimiser.zero_grad()
        loss = timed("forward", lambda: F.mse_loss(net(x), target), step > 0)
        timed("backward", loss.backward, step > 0)
        timed("adamw", optimiser.step, step > 0)
        losses.append(round(loss.item(), 6))
    wall = best["forward_sec"] + best["backward_sec"]
    print(json.dumps({
        "torch": torch.__version__, "threads": torch.get_num_threads(),
        "parameters": sum(t.numel() for t in net.parameters()), "batch": a.batch, "tokens": a.tokens,
        **{k: round(v, 4) for k, v in best.items()},
        "sec_per_sample": round(wall / a.batch, 4),
        "cpu_sec_per_sample": round((best["forward_cpu_sec"] + best["backward_cpu_sec"]) / a.batch, 4),
        "samples_per_sec": round(a.batch / (wall + best["adamw_sec"]), 2), "losses": losses,
    }))


if __name__ == "__main__":
    main()
