module spikeserve.invalid/robot

go 1.19
