"""One replica through time: free flight, collisions, and the running sums of what they do.

It imports `contact` and `model`. Begin with `advance`, which selects the engine; `jax_engine` is
the reference. Who calls whom, from ``jg.sample`` and ``jg.advance`` down to the loop over events:

    advance.advance_replica              one replica, by the engine of ``advance.engine_of``
        engine.Jax.advance               batches and derivatives of
            jax_engine.advance_by_jax    blocks of steps, each a loop over events
                step.event               new velocities and sums by ``fly`` and ``collide``
        engine.Numba.advance
            numba_engine.observed.advance_by_numba
                numba_engine.call.advance_unobserved    all blocks by one call of XLA, or, where a
                numba_engine.observed._advance_observed    function observes, by one after another
                    numba_engine.call.call_numba
                        numba_engine.handler.handler    replicas of a batch, on several threads
                            numba_engine.loop.time_loop    the loop over events
"""
