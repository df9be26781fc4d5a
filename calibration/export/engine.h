/* ---- the program: the same for every rig ------------------------------------------------------------------------ */

/* Axes as columns; origin, mm; the motion's own size, rad or mm, and for a rotation its cosine and sine. */
typedef struct { double r[3][3]; double t[3]; double size, c, s; } rigcal_frame_t;

/* Cosine and sine of a rotation. Close to a known rotation they are computed from the difference by series, whose first
   omitted term is then below 1e-20. */
static inline void rigcal_turn(double size, const rigcal_frame_t *known, rigcal_frame_t *out)
{
    const double d = known ? size - known->size : 1.0, dd = d * d;
    out->size = size;
    if (dd > 0.0025) {
        out->c = cos(size);
        out->s = sin(size);
        return;
    }
    const double s = d * (1.0 - dd / 6.0 * (1.0 - dd / 20.0 * (1.0 - dd / 42.0 * (1.0 - dd / 72.0))));
    const double v = dd / 2.0 * (1.0 - dd / 12.0 * (1.0 - dd / 30.0 * (1.0 - dd / 56.0)));   /* 1 - cos(d) */
    out->c = known->c - (known->c * v + known->s * s);
    out->s = known->s + (known->c * s - known->s * v);
}

/* Frames of all motions at joint values q, deg and mm; `known` may be the frames at close joint values, or NULL. */
static inline void rigcal_pose(const double q[RIGCAL_JOINTS], const rigcal_frame_t *known,
                               rigcal_frame_t at[RIGCAL_MOTIONS])
{
    for (int k = 0; k < RIGCAL_MOTIONS; k++) {
        const double *f = rigcal_fixed[k];
        rigcal_frame_t *out = &at[k];
        if (rigcal_parent[k] < 0) {
            for (int i = 0; i < 3; i++) {
                for (int j = 0; j < 3; j++) out->r[i][j] = f[4 * i + j];
                out->t[i] = f[4 * i + 3];
            }
        } else {
            const rigcal_frame_t *p = &at[rigcal_parent[k]];
            for (int i = 0; i < 3; i++) {
                for (int j = 0; j < 3; j++)
                    out->r[i][j] = p->r[i][0] * f[j] + p->r[i][1] * f[4 + j] + p->r[i][2] * f[8 + j];
                out->t[i] = p->r[i][0] * f[3] + p->r[i][1] * f[7] + p->r[i][2] * f[11] + p->t[i];
            }
        }
        double size = 0.0;
        for (int d = rigcal_first_drive[k]; d < rigcal_first_drive[k + 1]; d++)
            size += rigcal_drive_size[d] * q[rigcal_drive_joint[d]];
        const int a = rigcal_axis[k], u = (a + 1) % 3, v = (a + 2) % 3;
        if (rigcal_kind[k] == 2) {
            for (int i = 0; i < 3; i++) out->t[i] += size * out->r[i][a];
        } else {
            rigcal_turn(size, known ? &known[k] : NULL, out);
            for (int i = 0; i < 3; i++) {
                const double x = out->r[i][u], y = out->r[i][v];
                out->r[i][u] = out->c * x + out->s * y;
                out->r[i][v] = out->c * y - out->s * x;
            }
        }
    }
}

/* Position, mm, of a point fixed to a motion; motion -1 is the base. */
static inline void rigcal_place(const rigcal_frame_t at[], int motion, const double point[3], double out[3])
{
    const int k = motion;
    for (int i = 0; i < 3; i++)
        out[i] = k < 0 ? point[i]
                       : at[k].r[i][0] * point[0] + at[k].r[i][1] * point[1] + at[k].r[i][2] * point[2] + at[k].t[i];
}

static inline int rigcal_carries(int motion, int prism)
{
    return rigcal_prism_motion[prism] >= 0 && rigcal_beyond[motion][rigcal_prism_motion[prism]];
}

/* Derivative of a point's position with respect to the size of a motion, mm per rad or mm. */
static inline void rigcal_slope(const rigcal_frame_t *at, int kind, int axis, const double point[3], double out[3])
{
    const double a[3] = {at->r[0][axis], at->r[1][axis], at->r[2][axis]};
    if (kind == 2) {
        for (int i = 0; i < 3; i++) out[i] = a[i];
        return;
    }
    const double w[3] = {point[0] - at->t[0], point[1] - at->t[1], point[2] - at->t[2]};
    out[0] = a[1] * w[2] - a[2] * w[1];
    out[1] = a[2] * w[0] - a[0] * w[2];
    out[2] = a[0] * w[1] - a[1] * w[0];
}

/* Weight (N) that a motion carries, or all weight for motion -1, and its moment about a point (N mm). The table has the
   weight (N) and moment (N mm) of each motion. */
static inline void rigcal_hang(const rigcal_frame_t at[], const double table[RIGCAL_MOTIONS][4], int motion,
                               const double about[3], double sum[4])
{
    for (int i = 0; i < 4; i++) sum[i] = 0.0;
    for (int k = motion < 0 ? 0 : motion; k < RIGCAL_MOTIONS; k++) {
        const double *m = table[k];
        if (motion >= 0 && !rigcal_beyond[motion][k]) continue;
        if (m[0] == 0.0 && m[1] == 0.0 && m[2] == 0.0 && m[3] == 0.0) continue;
        sum[0] += m[0];
        for (int i = 0; i < 3; i++)
            sum[1 + i] += at[k].r[i][0] * m[1] + at[k].r[i][1] * m[2] + at[k].r[i][2] * m[3]
                          + m[0] * (at[k].t[i] - about[i]);
    }
}

/* Moment, N m, of the weights that a motion carries about its origin. */
static inline void rigcal_moment(const double sum[4], double out[3])
{
    const double *g = rigcal_down;
    out[0] = (sum[2] * g[2] - sum[3] * g[1]) / 1e3;
    out[1] = (sum[3] * g[0] - sum[1] * g[2]) / 1e3;
    out[2] = (sum[1] * g[1] - sum[2] * g[0]) / 1e3;
}

/* Load of gravity on a joint, N m or N; a positive load increases the joint's value. */
static inline double rigcal_load(const rigcal_frame_t at[], const double table[RIGCAL_MOTIONS][4], int joint)
{
    double load = 0.0;
    for (int k = 0; k < RIGCAL_MOTIONS; k++)
        for (int d = rigcal_first_drive[k]; d < rigcal_first_drive[k + 1]; d++) {
            if (rigcal_drive_joint[d] != joint) continue;
            const int a = rigcal_axis[k];
            double sum[4], m[3], part = 0.0;
            rigcal_hang(at, table, k, at[k].t, sum);
            if (rigcal_kind[k] == 1) {
                rigcal_moment(sum, m);
                for (int i = 0; i < 3; i++) part += at[k].r[i][a] * m[i];
                part *= 1e3;
            } else {
                for (int i = 0; i < 3; i++) part += at[k].r[i][a] * rigcal_down[i] * sum[0];
            }
            load += rigcal_drive_size[d] * part;
        }
    return load * rigcal_load_unit[joint];
}

/* The requested prisms: their numbers, positions at the readings and shifts by effects, mm. */
typedef struct {
    int count;
    const int *prism;
    double place[RIGCAL_PRISMS][3], shift[RIGCAL_PRISMS][3];
} rigcal_points_t;

/* A link that rotates about its joint in proportion to a moment: adds the shift of the prisms, mm.
   `along` is 1 for the component of the moment along the axis, 0 for the component across it. */
static inline void rigcal_bend(const rigcal_frame_t at[], const double table[RIGCAL_MOTIONS][4], int motion, int along,
                               double amount, rigcal_points_t *points)
{
    double sum[4], m[3], turn[3], about = 0.0;
    const int a = rigcal_axis[motion];
    rigcal_hang(at, table, motion, at[motion].t, sum);
    rigcal_moment(sum, m);
    for (int i = 0; i < 3; i++) about += at[motion].r[i][a] * m[i];
    for (int i = 0; i < 3; i++) {
        const double on_axis = at[motion].r[i][a] * about;
        turn[i] = amount * (along ? on_axis : m[i] - on_axis);
    }
    for (int p = 0; p < points->count; p++) {
        if (!rigcal_carries(motion, points->prism[p])) continue;
        const double w[3] = {points->place[p][0] - at[motion].t[0], points->place[p][1] - at[motion].t[1],
                             points->place[p][2] - at[motion].t[2]};
        points->shift[p][0] += turn[1] * w[2] - turn[2] * w[1];
        points->shift[p][1] += turn[2] * w[0] - turn[0] * w[2];
        points->shift[p][2] += turn[0] * w[1] - turn[1] * w[0];
    }
}

/* A boom from the origin of frame `root` to the origin of frame `tip`: returns its length, mm; also gives its two ends
   and its axis. */
static inline double rigcal_boom(const rigcal_frame_t at[], int root, int tip, double from[3], double to[3],
                                 double axis[3])
{
    double length = 0.0;
    rigcal_place(at, rigcal_frame_motion[root], rigcal_frame_origin[root], from);
    rigcal_place(at, rigcal_frame_motion[tip], rigcal_frame_origin[tip], to);
    for (int i = 0; i < 3; i++) length += (to[i] - from[i]) * (to[i] - from[i]);
    length = sqrt(length);
    for (int i = 0; i < 3; i++) axis[i] = (to[i] - from[i]) / fmax(length, 1e-6);
    return length;
}

static inline double rigcal_dot(const double a[3], const double b[3])
{
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static inline void rigcal_cross(const double a[3], const double b[3], double out[3])
{
    out[0] = a[1] * b[2] - a[2] * b[1];
    out[1] = a[2] * b[0] - a[0] * b[2];
    out[2] = a[0] * b[1] - a[1] * b[0];
}

/* A beam that bends under a force `tip_newton` and the moment of a table's weights at its tip, and a force `own_newton`
   distributed along it, in units of its flexibility. */
static inline void rigcal_droop(const rigcal_frame_t at[], int root, int tip, const double table[RIGCAL_MOTIONS][4],
                                double tip_newton, double own_newton, rigcal_points_t *points)
{
    double from[3], to[3], e[3], hanging[4], first[3], moment[3];
    const double *g = rigcal_down, length = rigcal_boom(at, root, tip, from, to, e) / 1e3, rise = rigcal_dot(e, g);
    rigcal_hang(at, table, -1, to, hanging);
    for (int i = 0; i < 3; i++) first[i] = hanging[1 + i] / 1e3;
    rigcal_cross(first, g, moment);
    for (int p = 0; p < points->count; p++) {
        double s[3], lever[3], by_moment[3], twist[3];
        if (!rigcal_holds[tip][points->prism[p]]) continue;
        for (int i = 0; i < 3; i++) s[i] = (points->place[p][i] - to[i]) / 1e3;
        for (int i = 0; i < 3; i++) lever[i] = e[i] * length * length / 2.0 + s[i] * length;
        const double along = rigcal_dot(e, s), below = rigcal_dot(g, s), on_axis = rigcal_dot(moment, e);
        rigcal_cross(moment, lever, by_moment);
        rigcal_cross(e, s, twist);
        for (int i = 0; i < 3; i++) {
            const double across = (g[i] - rise * e[i]) * length * length * length;
            const double turning = (along * g[i] - below * e[i]) * length * length;
            points->shift[p][i] += 1e3 * (by_moment[i] - on_axis * twist[i] * length
                                  + tip_newton * (across / 3.0 + turning / 2.0)
                                  + own_newton * (across / 8.0 + turning / 6.0));
        }
    }
}

/* The inner section of a boom tilts about the mouth of the outer section until its pads touch. */
static inline void rigcal_pads(const rigcal_frame_t at[], int root, int tip, const double table[RIGCAL_MOTIONS][4],
                               double outer_mm, double overlap_mm, double clearance_mm,
                               rigcal_points_t *points)
{
    double from[3], to[3], e[3], mouth[3], hanging[4], about[3];
    rigcal_boom(at, root, tip, from, to, e);
    for (int i = 0; i < 3; i++) mouth[i] = from[i] + outer_mm * e[i];
    rigcal_hang(at, table, -1, mouth, hanging);
    for (int i = 0; i < 3; i++) about[i] = hanging[1 + i];
    const double rise = rigcal_dot(e, rigcal_down), level = sqrt(fmax(1.0 - rise * rise, 0.0));
    const double side = rigcal_dot(about, e) - rigcal_dot(about, rigcal_down) * rise;
    if (level <= 1e-6) return;
    const double tilt = clearance_mm * ((side > 0.0) - (side < 0.0)) / (overlap_mm * level);
    for (int p = 0; p < points->count; p++) {
        double s[3];
        if (!rigcal_holds[tip][points->prism[p]]) continue;
        for (int i = 0; i < 3; i++) s[i] = points->place[p][i] - mouth[i];
        const double along = rigcal_dot(e, s), below = rigcal_dot(rigcal_down, s);
        for (int i = 0; i < 3; i++) points->shift[p][i] += tilt * (along * rigcal_down[i] - below * e[i]);
    }
}

/* One drive moves as if its joint read `amount` more, deg or mm: adds the shift of the prisms, mm. */
static inline void rigcal_follow(const rigcal_frame_t at[], int motion, int drive, double amount,
                                 rigcal_points_t *points)
{
    for (int p = 0; p < points->count; p++) {
        double s[3];
        if (!rigcal_carries(motion, points->prism[p])) continue;
        rigcal_slope(&at[motion], rigcal_kind[motion], rigcal_axis[motion], points->place[p], s);
        for (int i = 0; i < 3; i++) points->shift[p][i] += rigcal_drive_size[drive] * amount * s[i];
    }
}

static inline double rigcal_triangle(double s, double left, double middle, double right)
{
    const double a = fabs(s - left), b = fabs(s - middle), c = fabs(s - right);
    return ((c * c * c - b * b * b) / (right - middle) - (b * b * b - a * a * a) / (middle - left))
           / (6.0 * (right - left));
}

/* Weighted sum of cubic splines whose slope changes around inner knots, each minus a straight line. */
static inline double rigcal_curve(double s, int count, const double knots[], const double line[2][16],
                                  const double weight[], int symmetric)
{
    double out = 0.0;
    for (int k = 0; k < count; k++) {
        double value = rigcal_triangle(s, knots[k], knots[k + 1], knots[k + 2]);
        if (symmetric) value -= rigcal_triangle(-s, knots[k], knots[k + 1], knots[k + 2]);
        out += weight[k] * (value - line[0][k] - s * line[1][k]);
    }
    return out;
}

/* Uniform cubic B-splines over a range or a full turn. */
static inline double rigcal_splines(double deg, double low, double high, int pieces, int is_turn, int count,
                                    const double weight[])
{
    double at = (deg - low) / (high - low);
    at = pieces * (is_turn ? at - floor(at) : fmin(1.0, fmax(0.0, at)));
    int piece = (int)at;
    if (piece > pieces - 1) piece = pieces - 1;
    const double u = at - piece, v = 1.0 - u;
    return v * v * v / 6.0 * weight[piece % count]
           + (4.0 + 3.0 * u * u * (u - 2.0)) / 6.0 * weight[(piece + 1) % count]
           + (4.0 + 3.0 * v * v * (v - 2.0)) / 6.0 * weight[(piece + 2) % count]
           + u * u * u / 6.0 * weight[(piece + 3) % count];
}

static inline double rigcal_sign(double x) { return (x > 0.0) - (x < 0.0); }

/* ---- effects of this model -------------------------------------------------------------------------------------- */

/* Compute the changes by effects of the joint readings and of the prisms' positions. Returns 1 if an effect uses the
   pose at the readings, which is then in `at`. */
static inline int rigcal_effects(const double q[RIGCAL_JOINTS], const rigcal_inputs *in,
                                 rigcal_frame_t at[RIGCAL_MOTIONS], double change[RIGCAL_JOINTS],
                                 rigcal_points_t *points)
{
    for (int j = 0; j < RIGCAL_JOINTS; j++) change[j] = 0.0;
    for (int p = 0; p < points->count; p++)
        for (int i = 0; i < 3; i++) points->shift[p][i] = 0.0;
    (void)q;
    (void)in;
/*EFFECTS*/
}

static inline void rigcal_solve_pose(const double q[RIGCAL_JOINTS], const rigcal_inputs *in, int count,
                                     const int prism[], rigcal_frame_t at[RIGCAL_MOTIONS], double out_mm[][3])
{
    double change[RIGCAL_JOINTS], moved[RIGCAL_JOINTS];
    rigcal_frame_t read[RIGCAL_MOTIONS];
    rigcal_points_t points = {.count = count, .prism = prism};
    const int is_posed = rigcal_effects(q, in, read, change, &points);
    for (int j = 0; j < RIGCAL_JOINTS; j++) moved[j] = q[j] + change[j];
    rigcal_pose(moved, is_posed ? read : NULL, at);
    for (int p = 0; p < count; p++) {
        rigcal_place(at, rigcal_prism_motion[prism[p]], rigcal_prism_place[prism[p]], out_mm[p]);
        for (int i = 0; i < 3; i++) out_mm[p][i] += points.shift[p][i];
    }
}

/* ---- the inverse ------------------------------------------------------------------------------------------------ */

#define RIGCAL_CLOSE_MM 1e-9

/* Gauss-Newton steps from q, each with the least change of the joints in units of `range`. Returns the number of steps,
   or -1 on failure; q and off_mm are then the best joint values and their remaining distance. */
static inline int rigcal_approach(int count, const int prism[], const double *target_mm, const rigcal_inputs *in,
                                  const double range[RIGCAL_JOINTS], double q[RIGCAL_JOINTS], double *off_mm)
{
    enum { MOST = 3 * RIGCAL_PRISMS };
    double damping = 0.0, best = HUGE_VAL, kept[RIGCAL_JOINTS], error[MOST], slope[MOST][RIGCAL_JOINTS];
    int held[RIGCAL_JOINTS] = {0}, idle = 0;
    const int rows = 3 * count;
    for (int j = 0; j < RIGCAL_JOINTS; j++) {
        q[j] = fmin(fmax(q[j], rigcal_lower[j]), rigcal_upper[j]);
        kept[j] = q[j];
    }
    for (int step = 0; step < 200; step++) {
        rigcal_frame_t at[RIGCAL_MOTIONS];
        double place[RIGCAL_PRISMS][3], off = 0.0;
        rigcal_solve_pose(q, in, count, prism, at, place);
        for (int c = 0; c < count; c++)
            for (int i = 0; i < 3; i++) {
                const double e = target_mm[3 * c + i] - place[c][i];
                off += e * e;
            }
        off = sqrt(off);
        if (off < best) {
            const int is_fast = step > 1 && off < 0.01 * best;   /* then the slopes of the previous step suffice */
            idle = off < 0.5 * best ? 0 : idle + 1;
            best = off;
            damping *= 0.1;
            if (damping < 1e-12) damping = 0.0;
            for (int j = 0; j < RIGCAL_JOINTS; j++) kept[j] = q[j];
            if (off <= RIGCAL_CLOSE_MM) return step;
            for (int c = 0; c < count; c++) {
                for (int i = 0; i < 3; i++) error[3 * c + i] = target_mm[3 * c + i] - place[c][i];
                if (is_fast) continue;
                for (int i = 0; i < 3; i++)
                    for (int j = 0; j < RIGCAL_JOINTS; j++) slope[3 * c + i][j] = 0.0;
                for (int k = rigcal_prism_motion[prism[c]]; k >= 0; k = rigcal_parent[k]) {
                    double s[3];
                    rigcal_slope(&at[k], rigcal_kind[k], rigcal_axis[k], place[c], s);
                    for (int d = rigcal_first_drive[k]; d < rigcal_first_drive[k + 1]; d++)
                        for (int i = 0; i < 3; i++)
                            slope[3 * c + i][rigcal_drive_joint[d]] +=
                                rigcal_drive_size[d] * s[i] * range[rigcal_drive_joint[d]];
                }
            }
            for (int j = 0; j < RIGCAL_JOINTS; j++) held[j] = 0;
        } else {
            damping = damping > 0.0 ? 10.0 * damping : 1e-6;
            idle++;
        }
        if (idle > 40) break;
        /* Least change of the joints, in units of their ranges, that removes the error:
           dq = J' (J J' + damping)^-1 error. Joints at a limit that the step would cross are held. */
        for (int round = 0; round <= RIGCAL_JOINTS; round++) {
            double a[MOST][MOST + 1], most = 0.0;
            int crossed = 0;
            for (int r = 0; r < rows; r++) {
                for (int s = 0; s <= r; s++) {
                    double sum = 0.0;
                    for (int j = 0; j < RIGCAL_JOINTS; j++)
                        if (!held[j]) sum += slope[r][j] * slope[s][j];
                    a[r][s] = a[s][r] = sum;
                }
                most = fmax(most, a[r][r]);
                a[r][rows] = error[r];
            }
            for (int r = 0; r < rows; r++) a[r][r] += (damping + 1e-13) * most + 1e-30;
            for (int r = 0; r < rows; r++) {
                int p = r;
                for (int s = r + 1; s < rows; s++)
                    if (fabs(a[s][r]) > fabs(a[p][r])) p = s;
                for (int c = 0; p != r && c <= rows; c++) {
                    const double x = a[r][c];
                    a[r][c] = a[p][c];
                    a[p][c] = x;
                }
                for (int s = r + 1; s < rows; s++) {
                    const double f = a[s][r] / a[r][r];
                    for (int c = r; c <= rows; c++) a[s][c] -= f * a[r][c];
                }
            }
            for (int r = rows - 1; r >= 0; r--) {
                for (int c = r + 1; c < rows; c++) a[r][rows] -= a[r][c] * a[c][rows];
                a[r][rows] /= a[r][r];
            }
            double longest = 0.0, dq[RIGCAL_JOINTS];
            for (int j = 0; j < RIGCAL_JOINTS; j++) {
                dq[j] = 0.0;
                for (int r = 0; r < rows && !held[j]; r++) dq[j] += slope[r][j] * a[r][rows];
                longest = fmax(longest, fabs(dq[j]));
            }
            const double scale = longest > 0.2 ? 0.2 / longest : 1.0;
            for (int j = 0; j < RIGCAL_JOINTS; j++) {
                const double wanted = kept[j] + scale * dq[j] * range[j];
                q[j] = fmin(fmax(wanted, rigcal_lower[j]), rigcal_upper[j]);
                if (!held[j] && q[j] != wanted && (kept[j] <= rigcal_lower[j] || kept[j] >= rigcal_upper[j]))
                    held[j] = crossed = 1;
            }
            if (!crossed) break;
        }
    }
    for (int j = 0; j < RIGCAL_JOINTS; j++) q[j] = kept[j];
    *off_mm = best;
    return -1;
}

/* ---- public functions ------------------------------------------------------------------------------------------- */

/* Positions of all prisms in the base frame, mm, at joint readings q, deg and mm. `in` may be NULL: no input known. */
static inline void rigcal_forward(const double q[RIGCAL_JOINTS], const rigcal_inputs *in,
                                  double out_mm[RIGCAL_PRISMS][3])
{
    int prism[RIGCAL_PRISMS];
    rigcal_frame_t at[RIGCAL_MOTIONS];
    for (int p = 0; p < RIGCAL_PRISMS; p++) prism[p] = p;
    rigcal_solve_pose(q, in, RIGCAL_PRISMS, prism, at, out_mm);
}

/* Compute the joint commands that bring `count` prisms to their targets (x, y, z of each, base frame, mm), near the
   commands in q on entry and inside the joints' limits. Returns the number of steps, or -1 if a target remains farther
   away than RIGCAL_CLOSE_MM; q is then the best solution found. Play can leave a gap on the shortest path; the solver
   then holds back one joint after the other, so that the other joints go around the gap. */
static inline int rigcal_inverse(int count, const int prism[], const double *target_mm, const rigcal_inputs *in,
                                 double q[RIGCAL_JOINTS])
{
    double range[RIGCAL_JOINTS], start[RIGCAL_JOINTS], nearest[RIGCAL_JOINTS], best = HUGE_VAL, off = HUGE_VAL;
    for (int j = 0; j < RIGCAL_JOINTS; j++) {
        range[j] = rigcal_upper[j] - rigcal_lower[j];
        start[j] = nearest[j] = q[j];
    }
    for (int back = -1; back < RIGCAL_JOINTS; back++) {
        for (int j = 0; j < RIGCAL_JOINTS; j++) q[j] = start[j];
        if (back >= 0) range[back] *= 0.1;
        const int steps = rigcal_approach(count, prism, target_mm, in, range, q, &off);
        if (steps >= 0) return steps;
        if (back >= 0) range[back] *= 10.0;
        if (off >= best) continue;
        best = off;
        for (int j = 0; j < RIGCAL_JOINTS; j++) nearest[j] = q[j];
    }
    for (int j = 0; j < RIGCAL_JOINTS; j++) q[j] = nearest[j];
    return -1;
}

#endif
