"""The embedded host: Mitsuba 3 renders Tungsten's scenes, with an integrator and materials of our own."""
