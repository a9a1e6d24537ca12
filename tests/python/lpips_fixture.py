"""Writes tests/fixtures/lpips_{vgg,alex}.safetensors: narrow VGG-16 and AlexNet shapes with random weights, two pictures,
and the distance and gradient PyTorch finds.

    python lpips_fixture.py tests/fixtures

The distance is LPIPS's: scaled colours, features divided by their length, squared differences weighted by channel, mean
over the picture, summed over the places compared. Needs torch and safetensors; no trained weights.
"""
import sys
from pathlib import Path

import torch
import torch.nn.functional as F
from safetensors.torch import save_file

SHIFT = torch.tensor([-0.030, -0.088, -0.188]).view(1, 3, 1, 1)
SCALE = torch.tensor([0.458, 0.448, 0.450]).view(1, 3, 1, 1)


def vgg():
    """torchvision's VGG-16 numbering, a few channels wide."""
    layers, taps, channels = [], [], 3
    for width, convs in [(4, 2), (5, 2), (6, 3), (6, 3), (7, 3)]:
        if layers:
            layers.append(torch.nn.MaxPool2d(2, 2))
        for _ in range(convs):
            layers += [torch.nn.Conv2d(channels, width, 3, padding=1), torch.nn.ReLU()]
            channels = width
        taps.append(len(layers) - 1)
    return torch.nn.Sequential(*layers), taps, (3, 32, 48)


def alex():
    """torchvision's AlexNet numbering."""
    layers = [
        torch.nn.Conv2d(3, 6, 11, stride=4, padding=2), torch.nn.ReLU(), torch.nn.MaxPool2d(3, 2),
        torch.nn.Conv2d(6, 8, 5, padding=2), torch.nn.ReLU(), torch.nn.MaxPool2d(3, 2),
        torch.nn.Conv2d(8, 9, 3, padding=1), torch.nn.ReLU(),
        torch.nn.Conv2d(9, 7, 3, padding=1), torch.nn.ReLU(),
        torch.nn.Conv2d(7, 7, 3, padding=1), torch.nn.ReLU(),
    ]
    return torch.nn.Sequential(*layers), [1, 4, 7, 9, 11], (3, 45, 67)


def features(net, taps, x):
    x, out = (x - SHIFT) / SCALE, []
    for i, layer in enumerate(net):
        x = layer(x)
        if i in taps:
            out.append(x / (x.pow(2).sum(1, keepdim=True).add(1e-20).sqrt() + 1e-10))
    return out


def write(name, make, folder, seed):
    torch.manual_seed(seed)
    net, taps, size = make()
    pictures = torch.tanh(F.interpolate(torch.randn(2, 3, 9, 9), size[1:], mode="bilinear") + 0.1 * torch.randn(2, *size))
    pred, truth = pictures[:1].clone().requires_grad_(True), pictures[1:]
    a, b = features(net, taps, pred), features(net, taps, truth)
    lins = [torch.rand(1, x.shape[1], 1, 1) for x in a]
    distance = sum((lin * (x - y) ** 2).sum(1).mean() for lin, x, y in zip(lins, a, b))
    distance.backward()
    tensors = {f"features.{k}": v.detach() for k, v in net.state_dict().items()}
    tensors |= {f"lin{k}.model.1.weight": lin for k, lin in enumerate(lins)}
    tensors |= {"pred": pred.detach(), "truth": truth, "distance": distance.detach().reshape(1), "gradient": pred.grad}
    save_file({k: v.contiguous() for k, v in tensors.items()}, str(folder / f"lpips_{name}.safetensors"))
    print(name, float(distance), float(pred.grad.abs().max()))


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    write("vgg", vgg, folder, 1)
    write("alex", alex, folder, 2)
