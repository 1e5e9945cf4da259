/* A scalar CPU rasteriser of 3D Gaussian splats, the peer of cpu_rasterizer.py.
 *
 * The loops are those that CPU builds of 3DGS trainers run: Gaussians from near to far, each over the pixels of its
 * box, with an alpha cutoff and an early stop (Kerbl et al. 2023; Ye et al., "gsplat", 2024). What a pixel has blended
 * is logged, and the gradient walks each pixel's log from far to near. Projection and sort are not part of it.
 */
#include <math.h>
#include <stdlib.h>

#define MAX_ALPHA 0.99f
#define MIN_ALPHA (1.0f / 255.0f)
#define MIN_TRANSMITTANCE 1e-4f

typedef struct { /* a Gaussian on the screen, nearest first */
    float x, y;     /* centre, px */
    float a, b, c;  /* inverse of the 2D covariance */
    float opacity;
    float rgb[3];
    int left, right, top, bottom; /* pixels that it may touch, the last ones excluded */
} Splat;

typedef struct { /* the gradient by the same numbers */
    float x, y, a, b, c, opacity, rgb[3];
} Gradient;

typedef struct {
    int splat, previous; /* entry of the same pixel, or -1 */
} Entry;

static Entry *entries;
static int used, room;

static void blended(int splat, int *last) {
    if (used == room) {
        room = room ? 2 * room : 1 << 20;
        entries = realloc(entries, room * sizeof(Entry));
    }
    entries[used] = (Entry){splat, *last};
    *last = used++;
}

/* image: 3 floats a pixel; transmittance and last: one a pixel. */
void forward(int count, const Splat *splats, int width, int height, const float *background, float *image,
             float *transmittance, int *last) {
    int pixels = width * height;
    unsigned char *stopped = calloc(pixels, 1);
    used = 0;
    for (int p = 0; p < pixels; p++) {
        transmittance[p] = 1.0f;
        last[p] = -1;
        image[3 * p] = image[3 * p + 1] = image[3 * p + 2] = 0.0f;
    }
    for (int i = 0; i < count; i++) {
        const Splat *s = &splats[i];
        for (int row = s->top; row < s->bottom; row++)
            for (int column = s->left; column < s->right; column++) {
                int p = row * width + column;
                if (stopped[p]) continue;
                float dx = s->x - (column + 0.5f), dy = s->y - (row + 0.5f);
                float alpha = s->opacity * expf(-0.5f * (s->a * dx * dx + s->c * dy * dy) - s->b * dx * dy);
                if (alpha < MIN_ALPHA) continue;
                alpha = fminf(alpha, MAX_ALPHA);
                float behind = transmittance[p] * (1.0f - alpha);
                if (behind < MIN_TRANSMITTANCE) {
                    stopped[p] = 1;
                    continue;
                }
                float weight = alpha * transmittance[p];
                for (int k = 0; k < 3; k++) image[3 * p + k] += weight * s->rgb[k];
                transmittance[p] = behind;
                blended(i, &last[p]);
            }
    }
    for (int p = 0; p < pixels; p++)
        for (int k = 0; k < 3; k++) image[3 * p + k] += transmittance[p] * background[k];
    free(stopped);
}

/* gradients: zeros at first. Of the last call of `forward`. */
void backward(const Splat *splats, int width, int height, const float *background, const float *grad_image,
              const float *transmittance, const int *last, Gradient *gradients) {
    for (int p = 0; p < width * height; p++) {
        const float *grad = &grad_image[3 * p];
        float x = p % width + 0.5f, y = p / width + 0.5f, front = transmittance[p], behind[3];
        for (int k = 0; k < 3; k++) behind[k] = front * background[k];
        for (int at = last[p]; at >= 0; at = entries[at].previous) {
            const Splat *s = &splats[entries[at].splat];
            Gradient *g = &gradients[entries[at].splat];
            float dx = s->x - x, dy = s->y - y;
            float falloff = expf(-0.5f * (s->a * dx * dx + s->c * dy * dy) - s->b * dx * dy);
            float alpha = fminf(s->opacity * falloff, MAX_ALPHA), open = 1.0f / (1.0f - alpha);
            front *= open;
            float weight = alpha * front, grad_alpha = 0.0f;
            for (int k = 0; k < 3; k++) {
                g->rgb[k] += weight * grad[k];
                grad_alpha += (s->rgb[k] * front - behind[k] * open) * grad[k];
                behind[k] += weight * s->rgb[k];
            }
            if (s->opacity * falloff >= MAX_ALPHA) continue;
            g->opacity += falloff * grad_alpha;
            float grad_power = -alpha * grad_alpha;
            g->x += grad_power * (s->a * dx + s->b * dy);
            g->y += grad_power * (s->b * dx + s->c * dy);
            g->a += grad_power * 0.5f * dx * dx;
            g->b += grad_power * dx * dy;
            g->c += grad_power * 0.5f * dy * dy;
        }
    }
}
