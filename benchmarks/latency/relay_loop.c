/* Relay tests in C, for comparison: m y'' + n y' + y = u(t - D), a relay of height 1 at rest with a dead zone.

   The same loop as autotuner_sim/relay/kernel.py, written as a C programmer would: arrivals of the relay's output begin
   spans of constant input, turning points begin monotone pieces, Halley's method finds the passage of a threshold. By
   samples: the state is multiplied with a matrix from sample to sample. Euler's method: with a ring buffer. */

#include <math.h>
#include <stdlib.h>

typedef struct { int kind; double zeta, d, w0; } Plant;  /* kind 0 a single lag, 1 overdamped, 2 underdamped */

static Plant plant_of(double m, double n) {
    if (m == 0.0) return (Plant){0, 0.0, 0.0, 1.0 / n};
    double w0 = 1.0 / sqrt(m), zeta = 0.5 * n * w0, square = zeta * zeta - 1.0;
    return (Plant){square >= 0.0 ? 1 : 2, zeta, square >= 0.0 ? sqrt(square) + 1e-100 : sqrt(-square), w0};
}

static void solutions(const Plant *p, double t, double *c, double *o) {
    if (p->kind == 0) { *c = exp(-t); *o = 0.0; return; }
    if (p->kind == 2) {
        double decay = exp(-p->zeta * t);
        *c = decay * cos(p->d * t); *o = decay * sin(p->d * t) / p->d; return;
    }
    double decay = exp(-t / (p->zeta + p->d));
    *o = -0.5 * decay * expm1(-2.0 * p->d * t) / p->d; *c = decay - p->d * *o;
}

static void move(const Plant *p, double *z, double *v, double t) {
    double c, o, z0 = *z;
    solutions(p, t, &c, &o);
    *z = (c + p->zeta * o) * z0 + o * *v; *v = (c - p->zeta * o) * *v - o * z0;
}

static double next_turn(const Plant *p, double z, double v) {
    double part = p->d * v, whole = p->zeta * v + z;
    if (p->kind == 0) return INFINITY;
    if (p->kind == 2) { double a = atan2(part, whole); return (a > 0.0 ? a : a + M_PI) / p->d; }
    double ratio = part / whole;
    return ratio > 0.0 && ratio < 1.0 ? 0.5 * log1p(2.0 * part / (whole - part)) / p->d : INFINITY;
}

static double passage(const Plant *p, double z, double v, double to, double way, double low, double high, double turn) {
    if (p->kind == 0) return fmax(log(z / to), low);
    double t = next_turn(p, v, -2.0 * p->zeta * v - z), spacing = M_PI / p->d;
    if (p->kind == 2) t += spacing * floor((turn - t) / spacing);
    else if (t > turn || t == INFINITY) t = low;
    t = fmin(fmax(t, low), high);
    for (int k = 0; k < 80; k++) {
        double x = z, s = v;
        move(p, &x, &s, t);
        if (way * (x - to) > 0.0) high = t; else low = t;
        double newton = (x - to) / s, bend = -(2.0 * p->zeta + x / s);
        double step = newton / fmax(1.0 - 0.5 * newton * bend, 0.5);
        if (!(low <= t - step && t - step <= high)) step = t - (high < INFINITY ? 0.5 * (low + high) : 2.0 * low + 1.0);
        t -= step;
        if (fabs(step) * (1.0 + 2.0 * p->zeta) < 1e-9) break;
    }
    return t;
}

/* Fill in period and amplitude of the last cycle of tests (m, n, D, dead zone), one after the other. */
void by_events(const double *tests, long count, long switches, double *periods, double *peaks) {
    double *times = malloc((switches + 1) * sizeof *times), *furthest = malloc((switches + 1) * sizeof *furthest);
    for (long i = 0; i < count; i++, tests += 4) {
        Plant p = plant_of(tests[0], tests[1]);
        double D = tests[2] * p.w0, zone = tests[3], spacing = p.kind == 2 ? M_PI / p.d : INFINITY;
        double level = 1.0, z = -1.0, v = 0.0, begun = D, way = 1.0;
        long done = 0, arrived = 1;
        times[0] = 0.0;
        periods[i] = peaks[i] = NAN;
        for (;;) {
            double start = 0.0, at_start = z, turn = next_turn(&p, z, v), span;
            for (;;) {
                span = arrived <= done ? times[arrived] + D - begun : INFINITY;
                double end = fmin(turn, span), at_end = z, slope = v, to = way * zone - level;
                if (end < INFINITY) move(&p, &at_end, &slope, end); else at_end = 0.0;
                if (way * (at_end - to) > 0.0) {
                    if (way * (at_start - to) < 0.0) start = passage(&p, z, v, to, way, start, end, turn);
                    times[++done] = begun + start;
                    furthest[done] = level + to;
                    if (done == switches) goto next;
                    way = -way;
                    span = times[arrived] + D - begun;
                    end = fmin(turn, span);
                    at_end = z; slope = v;
                    move(&p, &at_end, &slope, end);
                } else if (span == INFINITY && way * at_end >= 0.0) goto next;
                if (way * (level + at_end - furthest[done]) < 0.0) furthest[done] = level + at_end;
                if (span <= turn) break;
                start = end; at_start = at_end; turn += spacing;
            }
            move(&p, &z, &v, span);
            double arriving = arrived % 2 ? -1.0 : 1.0;
            z += level - arriving; level = arriving; begun = times[arrived++] + D;
        }
    next:
        if (done < switches) continue;
        periods[i] = (times[switches] - times[switches - 2]) / p.w0;
        peaks[i] = fabs(furthest[switches - 1] - furthest[switches - 2]) / 2.0;
    }
    free(times); free(furthest);
}

/* Fill in the sample of the last switch of each test; each begins elsewhere in the noise, which goes round. */
void by_samples(const double *tests, long count, long switches, const double *noise, long size, const long *starts,
                double dt, long *last) {
    long *samples = malloc((switches + 1) * sizeof *samples);
    for (long i = 0; i < count; i++, tests += 4) {
        Plant p = plant_of(tests[0], tests[1]);
        double D = tests[2] * p.w0, zone = tests[3], step = dt * p.w0, c, o;
        double z0 = 0.0, v0 = 0.0, z = 0.0, v = 0.0, level = 0.0, begun = 0.0, arrival = D, way = 1.0, to = zone;
        long done = 0, arrived = 0, at = starts[i];
        solutions(&p, step, &c, &o);
        double a = c + p.zeta * o, b = c - p.zeta * o;
        samples[0] = 0;
        for (long k = 1; k < size && done < switches; k++) {
            double kept = z;
            z = a * z + o * v; v = b * v - o * kept;
            while (arrival <= k * step) {
                move(&p, &z0, &v0, arrival - begun);
                double arriving = arrived % 2 ? -1.0 : 1.0;
                z0 += level - arriving; level = arriving; begun = arrival; to = way * zone - level;
                arrival = ++arrived <= done ? samples[arrived] * step + D : INFINITY;
                z = z0; v = v0;
                move(&p, &z, &v, k * step - begun);
            }
            at = at + 1 < size ? at + 1 : 0;
            if (way * (z + noise[at] - to) > 0.0) {
                samples[++done] = k;
                way = -way; to = way * zone - level;
                if (arrived == done) arrival = k * step + D;
            }
        }
        last[i] = done == switches ? samples[switches] : -1;
    }
    free(samples);
}

/* Fill in period and amplitude of the last cycle by Euler's method with steps of dt. */
void by_euler(const double *tests, long count, long switches, double dt, double *periods, double *peaks) {
    for (long i = 0; i < count; i++, tests += 4) {
        double m = tests[0], n = tests[1], zone = tests[3], y = 0.0, v = 0.0, output = 1.0;
        double furthest[3] = {0.0}, times[3] = {0.0};
        long delay = lround(tests[2] / dt), at = 0, done = 0;
        double *pipe = calloc(delay + 1, sizeof *pipe);
        for (long k = 0; done < switches; k++) {
            if (output * y > zone) {
                output = -output; done++;
                times[done % 3] = k * dt; furthest[done % 3] = 0.0;
            }
            if (fabs(y) > fabs(furthest[done % 3])) furthest[done % 3] = y;
            pipe[at] = output;
            at = at < delay ? at + 1 : 0;
            double u = pipe[at];
            if (m > 0.0) { double slope = v; v += dt * (u - y - n * v) / m; y += dt * slope; }
            else y += dt * (u - y) / n;
        }
        periods[i] = times[done % 3] - times[(done + 1) % 3];
        peaks[i] = fabs(furthest[(done + 2) % 3] - furthest[(done + 1) % 3]) / 2.0;
        free(pipe);
    }
}
