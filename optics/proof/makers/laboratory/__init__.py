"""Benches of other laboratories, in plain numpy: how students and engineers measure polarized light, as they write it
down.

    bench     Stokes vectors through the parts of a bench; what can be wrong with it, as a flat table of numbers
    causes    what is hidden: a library effect by its usual law or by another, kinds that no library has
    session   a plan of readings: what is turned, what is noted, what the instrument does, what goes wrong every day
    design    signal to noise of what is hidden, and whether the session can tell it from every other cause
    folder    readings as a capture folder, written by hand

    student       films on hand-turned mounts with scales, a photodiode or a lux meter
    motor         a motor and an encoder: hundreds of readings
    polarimeter   a plate that is turned between polarizers, in one band or three
    laser         the same by light of one wavelength, which is no catalogue's
    runs          a film turned up and down, each way a run that has a name
    phone         a phone's camera through polarizers: the mean of a region, red, green and blue
    mosaic        a polarization camera: an analyser on every pixel, a panel of four unknown polarizations
    photographs   the same as images, a sheet beside bare light

Nothing here imports the library.
"""
