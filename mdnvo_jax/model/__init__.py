"""The network: convolution stack, BiLSTM, head."""
