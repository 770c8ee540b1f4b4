"""Record what PyTorch's layers compute and what its checkpoints look like, for tests/model.

pip install torch==2.13.0
python tests/golden/make_torch_golden.py tests/golden

Layers and checkpoints are PyTorch's own: Conv2d, BatchNorm2d and LeakyReLU in the layout of FlowNetS, nn.LSTM on packed
sequences, torch.save in both its layouts. Results are computed in float64 from weights rounded to float32, and stored
as float32. Everything is random from a fixed seed; a newer torch may draw other numbers, which is as good.

Files: `flownets*.pth*` (checkpoints with the names of the PyTorch port of FlowNet, at 1/32 and 1/64 of its channels),
`torch_stack.npz` (what the two at 1/32 compute), `torch_lstm.npz`.
"""

from __future__ import annotations

import sys
from collections import OrderedDict
from pathlib import Path

import numpy as np

if __name__ == "__main__":  # pytest imports this file in its search for doctests, without torch
    import torch
    from torch import nn

# name, kernel, stride, channels at full width
FLOWNET_LAYERS = [
    ("conv1", 7, 2, 64),
    ("conv2", 5, 2, 128),
    ("conv3", 5, 2, 256),
    ("conv3_1", 3, 1, 256),
    ("conv4", 3, 2, 512),
    ("conv4_1", 3, 1, 512),
    ("conv5", 3, 2, 512),
    ("conv5_1", 3, 1, 512),
    ("conv6", 3, 2, 1024),
]
# What FlowNet subtracts from B, G, R.
MEANS = [0.411, 0.432, 0.450]


def flownet(divisor: int, *, batch_norm: bool) -> nn.Sequential:
    """Return the encoder of FlowNetS or FlowNetS-BN with channels divided by `divisor` and random, lively values."""
    blocks, inputs = OrderedDict(), 6
    for name, size, stride, channels in FLOWNET_LAYERS:
        outputs = channels // divisor
        layers = [nn.Conv2d(inputs, outputs, size, stride, (size - 1) // 2, bias=not batch_norm)]
        if batch_norm:
            norm = nn.BatchNorm2d(outputs)
            nn.init.uniform_(norm.weight, 0.5, 1.5)
            nn.init.normal_(norm.bias, std=0.3)
            nn.init.normal_(norm.running_mean, std=0.3)
            nn.init.uniform_(norm.running_var, 0.5, 2.0)
            layers.append(norm)
        else:
            nn.init.normal_(layers[0].bias, std=0.1)
        nn.init.kaiming_normal_(layers[0].weight, 0.1)
        blocks[name] = nn.Sequential(*layers, nn.LeakyReLU(0.1))
        inputs = outputs
    return nn.Sequential(blocks)


def save(network: nn.Sequential, path: Path, *, arch: str, zipped: bool) -> None:
    """Write a checkpoint as the PyTorch port of FlowNet does, a layer of the decoder included."""
    state = network.state_dict()
    state["predict_flow6.weight"] = torch.randn(2, 3, 3, 3)
    content = {"epoch": 300, "arch": arch, "state_dict": state, "best_EPE": np.float64(1.951), "div_flow": 20}
    torch.save(content, path, _use_new_zipfile_serialization=zipped)


def array(tensor: torch.Tensor, dtype: type = np.float32) -> np.ndarray:
    """Return a tensor as an array; maps become channels-last."""
    values = tensor.detach().numpy()
    return (values.transpose(0, 2, 3, 1) if values.ndim == 4 else values).astype(dtype)


def make_stack(folder: Path) -> None:
    """Write the checkpoints and torch_stack.npz."""
    plain, normed = flownet(32, batch_norm=False), flownet(32, batch_norm=True)
    save(plain, folder / "flownets_legacy.pth.tar", arch="flownets", zipped=False)
    save(normed, folder / "flownets_bn_zip.pth", arch="flownets_bn", zipped=True)
    save(flownet(64, batch_norm=False), folder / "flownets_zip.pth", arch="flownets", zipped=True)
    save(flownet(64, batch_norm=True), folder / "flownets_bn_legacy.pth.tar", arch="flownets_bn", zipped=False)

    frames = np.random.default_rng(0).integers(0, 256, (3, 2, 33, 65, 3), dtype=np.uint8)  # RGB
    bgr = torch.from_numpy(frames[..., ::-1] / 255.0 - np.array(MEANS))
    pairs = torch.cat([bgr[:, 0], bgr[:, 1]], dim=-1).permute(0, 3, 1, 2)
    golden = {"frames": frames}
    with torch.no_grad():
        golden["plain_eval"] = array(plain.double().eval()(pairs))
        golden["bn_eval"] = array(normed.double().eval()(pairs))

    pairs.requires_grad_()
    outputs = normed.train()(pairs)
    cotangent = torch.randn(outputs.shape, dtype=torch.float32)
    (outputs * cotangent).sum().backward()
    golden["bn_train"], golden["cotangent"] = array(outputs), array(cotangent)
    golden["bn_train_grad_pair0"] = array(pairs.grad[:1])
    golden["bn_train_grad_conv3_1_kernel"] = normed.conv3_1[0].weight.grad.numpy().transpose(2, 3, 1, 0).astype("f4")
    golden["bn_train_grad_conv2_scale"] = array(normed.conv2[1].weight.grad)
    for name, *_ in FLOWNET_LAYERS:
        norm = getattr(normed, name)[1]
        golden[f"after_{name}_mean"], golden[f"after_{name}_var"] = array(norm.running_mean), array(norm.running_var)
    np.savez_compressed(folder / "torch_stack.npz", **golden)


def make_lstm(folder: Path) -> None:
    """Write torch_lstm.npz: two layers, windows of 6, 4 and 1 steps, both directions and causal."""
    lengths = [6, 4, 1]
    inputs = torch.randn(3, max(lengths), 5, dtype=torch.float32).double()
    golden = {"inputs": array(inputs), "lengths": np.array(lengths)}
    for kind, bidirectional in (("both", True), ("causal", False)):
        lstm = nn.LSTM(5, 4, num_layers=2, batch_first=True, bidirectional=bidirectional).double()
        for values in lstm.parameters():
            # Large enough for the gates to saturate now and then, and exact in float32.
            values.data = (values.data * 3).float().double()
        given = inputs.clone().requires_grad_()
        packed = nn.utils.rnn.pack_padded_sequence(given, lengths, batch_first=True)
        outputs, _ = nn.utils.rnn.pad_packed_sequence(lstm(packed)[0], batch_first=True)
        cotangent = torch.randn(outputs.shape, dtype=torch.float32)
        (outputs * cotangent).sum().backward()
        golden |= {f"{kind}_outputs": array(outputs), f"{kind}_cotangent": array(cotangent)}
        golden[f"{kind}_grad_inputs"] = array(given.grad)
        for name, values in lstm.named_parameters():
            golden[f"{kind}_{name}"], golden[f"{kind}_grad_{name}"] = array(values), array(values.grad)
    np.savez_compressed(folder / "torch_lstm.npz", **golden)


if __name__ == "__main__":
    if len(sys.argv) != 2 or not Path(sys.argv[1]).is_dir():
        raise SystemExit(f"usage: {sys.argv[0]} FOLDER\n\n{__doc__}")
    torch.manual_seed(0)
    make_stack(Path(sys.argv[1]))
    make_lstm(Path(sys.argv[1]))
